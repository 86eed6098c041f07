"""Robot: the posture that the arm starts in or is pulled to. Physics layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Nearest, PhysicsPerturbation, level_from, pick
from pipeline.errors import RefusedError
from pipeline.libero.starts import HOME_RAD
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, RollOut, Scene, Task

Joints = tuple[float, float, float, float, float, float, float]
Norm = Annotated[float, Field(ge=0.0001, le=np.pi)]

LIMIT_MARGIN_RAD = 0.05
"""How far from its limits every joint must start."""

Component = Literal["initial_joints", "controller_posture"]


class RobotPerturbation(PhysicsPerturbation):
    """A posture away from where the demonstration starts.

    ``initial_joints`` puts the arm there, and the controller holds it there. ``controller_posture`` does what
    LIBERO-Plus's robot tasks do: there the reset has another posture, and then the recorded state is put in. So the arm
    starts where it was recorded, and the controller pulls it, while the scene settles and all through the episode, to
    the posture by its null space, and to the posture's hand orientation until an action turns the hand.

    The offset is added to the same of the clean twin: ``initial_joints`` to the recorded start, which LIBERO's reset
    scattered by 0.02 to 0.10 rad about home, ``controller_posture`` to the posture of the reset. Only so is the change
    as large as its level says, and no offset the clean twin.

    Attributes:
        joint_offsets_rad: base to wrist.
    """

    axis: Literal["robot"] = "robot"
    component: Component
    joint_offsets_rad: Joints

    # A fifth of the weakest offset, and less than half of the 0.05 rad by which LIBERO's own reset scatters the start.
    clearance: ClassVar[float] = 0.02
    unit: ClassVar[str | None] = "rad"
    measure: ClassVar[str] = "the norm of the difference between the joint offsets"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """The scene with the arm turned and at rest, or with the controller's posture; all else stays as it is.

        Raises:
            RefusedError: ``joint_limit`` when a joint comes too near its limit, ``robot_in_collision`` when the robot
                is put where it touches what it did not touch before, ``test_posture`` when recorded start and offset
                happen to add up to a posture of the test set.
        """
        from pipeline.scenes.compiled import ARM, CompiledScene

        compiled = CompiledScene(scene)
        data, model = compiled.data, compiled.model
        before = compiled.touching().keys()
        joints = [model.joint(name) for name in ARM]
        arm = [joint.qposadr[0] for joint in joints]
        pulled = self.component == "controller_posture" and scene.posture_rad is not None
        posture = (scene.posture_rad if pulled else data.qpos[arm]) + np.array(self.joint_offsets_rad)
        low, high = np.array([joint.range for joint in joints]).T
        if (posture < low + LIMIT_MARGIN_RAD).any() or (posture > high - LIMIT_MARGIN_RAD).any():
            raise RefusedError("joint_limit")
        if np.linalg.norm(HOME_RAD + benchmark_offsets_rad() - posture, axis=1).min() < self.clearance:
            raise RefusedError("test_posture")
        data.qpos[arm] = posture
        data.qvel[[joint.dofadr[0] for joint in joints]] = 0.0
        state = compiled.state
        compiled.restore(state)
        if self.component == "controller_posture":
            from scipy.spatial.transform import Rotation  # takes long, and every process of a run imports the axes

            hand = Rotation.from_matrix(data.site("gripper0_grip_site").xmat.reshape(3, 3))
            drawn_to = {"posture_rad": posture.tolist(), "goal_wxyz": hand.as_quat(scalar_first=True).tolist()}
            return replace(scene, posture_rad=tuple(posture.tolist()), resolved={**scene.resolved, "robot": drawn_to})
        if compiled.touching().keys() - before:
            raise RefusedError("robot_in_collision")
        resolved = {**scene.resolved, "robot": {"joints_rad": posture.tolist()}}
        return replace(scene, state=state, posture_rad=None, resolved=resolved)

    def distances(self, test: TestSet, task: Task) -> Floats:
        """To the offsets of all robot tasks; the arm is the same in all, so ``task`` does not matter."""
        return self._apart_rad(benchmark_offsets_rad())[[int(one.parameters["id"]) - 1 for one in test.of("robot")]]

    def apart(self, others: Sequence[RobotPerturbation]) -> Floats:
        """To the offsets of all, as the arm is the same in all tasks."""
        return self._apart_rad([other.joint_offsets_rad for other in others])

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """Compared with all 500 offsets of the benchmark, of which its robot tasks use 450; the arm is the same in all
        tasks, so ``task`` does not matter."""
        compared = len(test.of("robot"))
        return Nearest(float(self._apart_rad(benchmark_offsets_rad()).min()) if compared else np.inf, compared)

    def _apart_rad(self, offsets_rad: ArrayLike) -> Floats:
        """(N,) from offsets (N, 7)."""
        return np.asarray(np.linalg.norm(np.subtract(offsets_rad, self.joint_offsets_rad), axis=1))


@cache
def benchmark_offsets_rad() -> Floats:
    """(500, 7) the benchmark's offsets, row ``id - 1``: 100 random directions at each norm from 0.1 to 0.5 rad.

    Reproduces the tables of LIBERO-Plus's ``MountedPanda<id>`` and ``OnTheGroundPanda<id>`` classes, which were made
    with NumPy's legacy generator, to 1e-8 rad.
    """
    directions = np.random.RandomState(42).randn(500, 7)
    norms = np.repeat([0.1, 0.2, 0.3, 0.4, 0.5], 100)
    return np.asarray(directions * (norms / np.linalg.norm(directions, axis=1))[:, None])


class RobotAxis(Axis):
    """Offsets in all directions with equal chance.

    Attributes:
        components: what to draw, each entry as often as the others. By default three of four are the benchmark's.
        norm_rad: the norm of a controller's posture at each level; the defaults are the benchmark's.
        initial_norm_rad: the same of initial joints. Of the defaults nine of ten starts are within 10 cm of the hand's
            unchanged first observation, as nearly all robot tests are; at the benchmark's norms half were further away.
    """

    draws: ClassVar = (RobotPerturbation,)

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = (
        *("controller_posture", "controller_posture", "controller_posture"),
        "initial_joints",
    )
    norm_rad: ByLevel[Norm] = (0.1, 0.2, 0.3, 0.4, 0.5)
    initial_norm_rad: ByLevel[Norm] = (0.06, 0.1, 0.14, 0.18, 0.22)

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """By the norm of the offset, 0.1 rad a level."""
        return level_from(float(tested.parameters["id"]) / 100)

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> RobotPerturbation:
        level = self.draw_level(rng)
        component = pick(rng, self.components)
        direction = rng.standard_normal(7)
        norms_rad = self.initial_norm_rad if component == "initial_joints" else self.norm_rad
        offsets = direction * (norms_rad[level - 1] / np.linalg.norm(direction))
        return RobotPerturbation.model_validate(
            {"component": component, "level": level, "joint_offsets_rad": offsets.round(6).tolist()}
        )
