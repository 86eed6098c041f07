"""Disturbance: a push on the robot's hand during the episode. Physics layer."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Intervals, PhysicsPerturbation, pick
from pipeline.axes.report_data import ObservedEpisode
from pipeline.episode_schema import SCHEMA
from pipeline.errors import RejectedError
from pipeline.libero.starts import kept_actions
from pipeline.types import Demo, Floats, Push, RollOut, Scene, Task

STEP_S = 1 / SCHEMA.fps_hz
"""Duration of a control step."""

HAND = "robot0_right_hand"
"""Body between the arm's last joint and the gripper, which carries both fingers."""

RISE = 0.5
"""Largest sine of the angle between a push and the horizontal plane: 30 degrees up or down, because tables are below.
"""

Wrench = tuple[float, float, float, float, float, float]
Steps = Annotated[int, Field(ge=0, le=1000)]
Duration = Annotated[int, Field(ge=1, le=100)]


class DisturbancePerturbation(PhysicsPerturbation):
    """A force on the hand from a given control step for a given number of steps, independent of the policy.

    Attributes:
        body: body of MuJoCo's model on whose centre of mass the force acts.
        wrench: (6,) force in N and torque in N m along the world's axes, constant over the steps.
        first_step: executed actions between the first observation and the push.
        steps: duration in control steps of 50 ms.
        away_steps: least number of control steps between either end of the push and an opening or closing of the
            gripper.
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
        """Return the scene with the push; the initial state stays as it is.

        Steps are counted in the demonstration without its no-ops, as it is replayed by default.

        Raises:
            RejectedError: when ``fault_of`` returns a reason for the demonstration's own actions.
        """
        fault = self.fault_of(demo.actions[kept_actions(demo.actions, "drop")])
        if fault:
            raise RejectedError(fault)
        push = Push(self.body, self.wrench, self.first_step, self.steps)
        start = replace(scene.start, push=push)
        return replace(scene, start=start, resolved={**scene.resolved, "disturbance": push._asdict()})

    def fault_of(self, actions: Floats) -> str | None:
        """Return the reason why the push does not fit the executed ``actions`` (K, 7), else ``None``.

        ``push_at_grasp``: the gripper opens or closes within ``away_steps`` of the push.
        ``push_after_end``: the actions end within ``away_steps`` of the push, or before.
        """
        gripper, end = actions[:, 6], self.acts_until
        if end + self.away_steps > len(gripper):
            return "push_after_end"
        near = gripper[max(self.first_step - self.away_steps - 1, 0) : end + self.away_steps]
        return "push_at_grasp" if (near != near[0]).any() else None

    @property
    def impulse_n_s(self) -> Floats:
        """Impulse (3,) of the push along the world's axes."""
        return np.array(self.wrench[:3]) * self.steps * STEP_S

    def distances_to(self, others: Sequence[DisturbancePerturbation]) -> Floats:
        """Return the distances (N,) to pushes that begin at the same step; NaN for pushes at another step."""
        apart_n_s = [float(np.linalg.norm(self.impulse_n_s - push.impulse_n_s)) for push in others]
        return np.where([self.first_step == push.first_step for push in others], apart_n_s, math.nan)

    @property
    def acts_until(self) -> int:
        """Control step after the last step of the push."""
        return self.first_step + self.steps

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the distance of the hand from its place in the clean twin, at the end of the push."""
        look, twin = episode.look(self.acts_until), episode.twin_look(self.acts_until)
        if twin is not None:
            yield (
                f"distance of the hand from that of the clean twin after a push of level {self.level} (cm)",
                look.moved_cm(twin),
            )


class DisturbanceAxis(Axis):
    """Pushes in all directions within 30 degrees of the horizontal plane, with equal probability.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
        impulse_n_s: Impulse of a push at each level, in N s: force times duration. The defaults displace the hand by
            about 1 to 5 cm.
        steps: Intervals of the duration in control steps, each with equal probability; by default 2 to 8 steps, which
            are 0.1 to 0.4 s.
        first_step: Intervals of the number of executed actions before the push, each with equal probability; by default
            5 to 18 and 58 to 66.
        away_steps: Least number of control steps between a push and a change of the gripper, in the demonstration and
            in the replay; 5 by default. At 0 the gripper may change directly before or after the push.
    """

    kinds: ClassVar = (DisturbancePerturbation,)
    colour: ClassVar = "#6b7d94"

    impulse_n_s: ByLevel[Annotated[float, Field(gt=0.0, le=100.0)]] = (4.0, 7.0, 10.0, 13.0, 16.0)
    steps: Intervals[Duration] = ((2, 8),)
    first_step: Intervals[Steps] = ((5, 18), (58, 66))
    away_steps: Steps = 5

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> DisturbancePerturbation:
        level = self.sample_level(rng)
        steps = _step(rng, self.steps)
        first_step = _step(rng, self.first_step)
        bearing_rad = rng.uniform(-math.pi, math.pi)
        rise = rng.uniform(-RISE, RISE)
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
    """Sample one of the stretches, then one of its steps, both ends included."""
    first, last = pick(rng, stretches)
    return int(rng.integers(first, last + 1))
