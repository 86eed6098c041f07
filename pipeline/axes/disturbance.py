"""Disturbance: a push on the robot's hand in the course of the episode. Physics layer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Intervals, PhysicsPerturbation, pick
from pipeline.episode_schema import SCHEMA
from pipeline.errors import RefusedError
from pipeline.libero.starts import kept_actions
from pipeline.types import Demo, Floats, Push, RollOut, Scene, Task

STEP_S = 1 / SCHEMA.fps_hz
"""A control step."""

HAND = "robot0_right_hand"
"""The body between the arm's last joint and the gripper, which carries both fingers."""

RISE = 0.5
"""Largest sine of the angle between a push and the horizontal plane: 30 degrees up or down, as tables are below."""

Wrench = tuple[float, float, float, float, float, float]
Steps = Annotated[int, Field(ge=0, le=1000)]
Duration = Annotated[int, Field(ge=1, le=100)]


class DisturbancePerturbation(PhysicsPerturbation):
    """A force on the hand that begins with a control step and ends after some, whatever the policy does.

    Attributes:
        body: of MuJoCo's model, on whose centre of mass the force acts.
        wrench: (6,) force in N and torque in N m along the world's axes, the same at each of the steps.
        first_step: executed actions before the push, since the first look.
        steps: control steps of 50 ms.
        away_steps: how far it must be from where the gripper opens or closes, at both ends.
    """

    axis: Literal["disturbance"] = "disturbance"
    component: Literal["push"] = "push"
    body: str
    wrench: Wrench
    first_step: int = Field(ge=0)
    steps: int = Field(ge=1)
    away_steps: int = Field(ge=0)

    unit: ClassVar[str | None] = "N s"
    measure: ClassVar[str] = (
        "the norm of the difference between impulses that begin at the same step; the benchmark has no such test"
    )

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """The scene with the push; where it starts stays as it is.

        Steps are counted in the demonstration without its no-ops, as it is replayed by default.

        Raises:
            RefusedError: a reason of ``fault_of``, here for the demonstration's own actions.
        """
        if fault := self.fault_of(demo.actions[kept_actions(demo.actions, "drop")]):
            raise RefusedError(fault)
        push = Push(self.body, self.wrench, self.first_step, self.steps)
        return replace(scene, push=push, resolved={**scene.resolved, "disturbance": push._asdict()})

    def fault_of(self, actions: Floats) -> str | None:
        """Return ``push_at_grasp`` where the gripper opens or closes within ``away_steps`` of the push,
        ``push_after_end`` where the actions (K, 7) end within them, else ``None``."""
        gripper, end = actions[:, 6], self.first_step + self.steps
        if end + self.away_steps > len(gripper):
            return "push_after_end"
        near = gripper[max(self.first_step - self.away_steps - 1, 0) : end + self.away_steps]
        return "push_at_grasp" if (near != near[0]).any() else None

    @property
    def impulse_n_s(self) -> Floats:
        """(3,) along the world's axes."""
        return np.array(self.wrench[:3]) * self.steps * STEP_S

    def apart(self, others: Sequence[DisturbancePerturbation]) -> Floats:
        """Compared with the pushes that begin at the same step."""
        apart_n_s = [float(np.linalg.norm(self.impulse_n_s - other.impulse_n_s)) for other in others]
        return np.where([self.first_step == other.first_step for other in others], apart_n_s, math.nan)


class DisturbanceAxis(Axis):
    """Pushes in all directions within 30 degrees of the horizontal plane, with equal chance.

    Attributes:
        impulse_n_s: force times duration at each level. The defaults displace the hand by about 1 to 5 cm.
        steps: control steps that a push takes, 0.1 to 0.4 s by default.
        first_step: executed actions before it; each of the stretches is drawn as often as the others.
        away_steps: control steps between a push and where the gripper opens or closes, in the demonstration and in the
            replay, which waits for the hand; at 0 it may come right before or after.
    """

    draws: ClassVar = (DisturbancePerturbation,)

    impulse_n_s: ByLevel[Annotated[float, Field(gt=0.0, le=100.0)]] = (4.0, 7.0, 10.0, 13.0, 16.0)
    steps: Intervals[Duration] = ((2, 8),)
    first_step: Intervals[Steps] = ((5, 18), (58, 66))
    away_steps: Steps = 5

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> DisturbancePerturbation:
        level = self.draw_level(rng)
        steps, first_step = _step(rng, self.steps), _step(rng, self.first_step)
        bearing_rad, rise = rng.uniform(-math.pi, math.pi), rng.uniform(-RISE, RISE)
        flat = math.sqrt(1 - rise**2)
        direction = np.array([flat * math.cos(bearing_rad), flat * math.sin(bearing_rad), rise])
        force_n = direction * self.impulse_n_s[level - 1] / (steps * STEP_S)
        return DisturbancePerturbation(
            level=level,
            body=HAND,
            wrench=(*force_n.round(4).tolist(), 0.0, 0.0, 0.0),
            first_step=first_step,
            steps=steps,
            away_steps=self.away_steps,
        )


def _step(rng: np.random.Generator, stretches: Intervals[int]) -> int:
    """One step of one of the stretches, both ends among them."""
    first, last = pick(rng, stretches)
    return int(rng.integers(first, last + 1))
