"""Robot: posture in which the arm starts, or to which the controller pulls it. Physics layer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Nearest, PhysicsPerturbation, level_from, pick
from pipeline.axes.report_data import (
    BENCHMARK,
    CoveragePlots,
    Groups,
    Histogram,
    KeptPerturbation,
    ObservedEpisode,
    Strips,
)
from pipeline.errors import RejectedError
from pipeline.libero.starts import HOME_RAD
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, RollOut, Scene, Task

if TYPE_CHECKING:
    from pipeline.scenes.look import Look

Joints = tuple[float, float, float, float, float, float, float]
Norm = Annotated[float, Field(ge=0.0001, le=np.pi)]

LIMIT_MARGIN_RAD = 0.05
"""Least distance of every joint's start from the joint's limits."""

Component = Literal["initial_joints", "controller_posture"]


class RobotPerturbation(PhysicsPerturbation):
    """A posture with an offset from the start of the demonstration.

    ``initial_joints`` puts the arm into the posture, and the controller holds it there. ``controller_posture`` copies
    LIBERO-Plus's robot tasks, in which the reset has another posture and the recorded state is restored afterwards. The
    arm then starts where it was recorded. While the scene settles and during the episode, the controller pulls the arm
    to the posture in its null space. Until an action turns the hand, it also pulls the hand to the posture's
    orientation.

    The offset is added to a posture of the clean twin. For ``initial_joints`` this is the recorded start, which
    LIBERO's reset scattered by 0.02 to 0.10 rad about home. For ``controller_posture`` it is the posture of the reset.
    Only then is the change as large as its level states, and an offset of zero the clean twin.

    Attributes:
        joint_offsets_rad: offsets of the joints, from base to wrist.
    """

    axis: Literal["robot"] = "robot"
    component: Component
    joint_offsets_rad: Joints

    # A fifth of the weakest offset, and less than half of the 0.05 rad by which LIBERO's own reset scatters the start.
    clearance: ClassVar[float] = 0.02
    unit: ClassVar[str | None] = "rad"
    measure: ClassVar[str] = "the norm of the difference between the joint offsets"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the scene with the arm turned and at rest, or with the controller's posture, otherwise unchanged.

        Raises:
            RejectedError: ``joint_limit``: a joint comes too near its limit.
                ``robot_in_collision``: the robot touches a thing that it did not touch before.
                ``test_posture``: recorded start and offset happen to add up to a posture of the test set.
        """
        from pipeline.scenes.compiled import ARM, CompiledScene

        compiled = CompiledScene(scene)
        data, model = compiled.data, compiled.model
        before = compiled.touching().keys()
        joints = [model.joint(name) for name in ARM]
        arm = [joint.qposadr[0] for joint in joints]
        posture_rad = self._reference_posture_rad(scene, data.qpos[arm]) + np.array(self.joint_offsets_rad)
        self._reject_posture(posture_rad, np.array([joint.range for joint in joints]))
        data.qpos[arm] = posture_rad
        data.qvel[[joint.dofadr[0] for joint in joints]] = 0.0
        state = compiled.state
        compiled.restore(state)
        if self.component == "controller_posture":
            hand_rotation = data.site("gripper0_grip_site").xmat.reshape(3, 3)
            return _with_controller_posture(scene, posture_rad, hand_rotation)
        if compiled.touching().keys() - before:
            raise RejectedError("robot_in_collision")
        resolved = {**scene.resolved, "robot": {"joints_rad": posture_rad.tolist()}}
        return replace(scene, state=state, start=replace(scene.start, posture_rad=None), resolved=resolved)

    def _reference_posture_rad(self, scene: Scene, recorded_rad: Floats) -> Floats:
        """Return the posture (7,) of the clean twin that the offset is added to.

        Args:
            recorded_rad: (7,) posture in which the arm starts.
        """
        if self.component == "controller_posture" and scene.start.posture_rad is not None:
            return np.array(scene.start.posture_rad)
        return recorded_rad

    def _reject_posture(self, posture_rad: Floats, ranges_rad: Floats) -> None:
        """Reject a posture (7,) at the limits of the joints, and a posture of the test set.

        Args:
            ranges_rad: (7, 2) lower and upper limit of each joint.

        Raises:
            RejectedError: ``joint_limit`` or ``test_posture``, see ``apply``.
        """
        low, high = ranges_rad.T
        if (posture_rad < low + LIMIT_MARGIN_RAD).any() or (posture_rad > high - LIMIT_MARGIN_RAD).any():
            raise RejectedError("joint_limit")
        if np.linalg.norm(HOME_RAD + benchmark_offsets_rad() - posture_rad, axis=1).min() < self.clearance:
            raise RejectedError("test_posture")

    def distances(self, test: TestSet, task: Task) -> Floats:
        """Return the distances (N,) to the offsets of all robot tasks; all tasks share one arm."""
        rows = [int(tested.parameters["id"]) - 1 for tested in test.on_axis("robot")]
        return self._distances_rad(benchmark_offsets_rad())[rows]

    def distances_to(self, others: Sequence[RobotPerturbation]) -> Floats:
        """Return the distances (N,) to the offsets of N perturbations of any task; all tasks share one arm."""
        return self._distances_rad([perturbation.joint_offsets_rad for perturbation in others])

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """Return the distance to the nearest of the benchmark's 500 offsets, of which its robot tasks use 450.

        All tasks share one arm, so the distance does not depend on ``task``.
        """
        compared = len(test.on_axis("robot"))
        if not compared:
            return Nearest(np.inf, compared)
        return Nearest(float(self._distances_rad(benchmark_offsets_rad()).min()), compared)

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the displacement and the rotation of the hand at the start from the clean twin's start."""
        twin = episode.twin_look()
        if twin is not None:
            yield from measure_start(episode.look(), twin, self.component, self.level)

    def _distances_rad(self, offsets_rad: ArrayLike) -> Floats:
        """Return the distances (N,) to offsets (N, 7)."""
        return np.asarray(np.linalg.norm(np.subtract(offsets_rad, self.joint_offsets_rad), axis=1))


def _with_controller_posture(scene: Scene, posture_rad: Floats, hand_rotation: Floats) -> Scene:
    """Return the scene with the posture (7,) to which the controller pulls the arm.

    Args:
        hand_rotation: (3, 3) orientation of the grip site in this posture, to which the controller pulls the hand.
    """
    from scipy.spatial.transform import Rotation  # takes long, and every process of a run imports the axes

    hand = Rotation.from_matrix(hand_rotation)
    pulled_to = {"posture_rad": posture_rad.tolist(), "goal_wxyz": hand.as_quat(scalar_first=True).tolist()}
    start = replace(scene.start, posture_rad=tuple(posture_rad.tolist()))
    return replace(scene, start=start, resolved={**scene.resolved, "robot": pulled_to})


@cache
def benchmark_offsets_rad() -> Floats:
    """Return the benchmark's offsets (500, 7), in row ``id - 1``: 100 random directions at each norm, 0.1 to 0.5 rad.

    They reproduce the tables of LIBERO-Plus's ``MountedPanda<id>`` and ``OnTheGroundPanda<id>`` classes, which were
    generated with NumPy's legacy generator, to 1e-8 rad.
    """
    directions = np.random.RandomState(42).randn(500, 7)
    norms = np.repeat([0.1, 0.2, 0.3, 0.4, 0.5], 100)
    return np.asarray(directions * (norms / np.linalg.norm(directions, axis=1))[:, None])


def measure_start(start: Look, twin: Look, component: str, level: int) -> Iterator[tuple[str, float]]:
    """Measure how far the hand is moved and turned in an episode's first observation, relative to its clean twin."""
    yield f"displacement of the hand by {component}, level {level} (cm)", start.moved_cm(twin)
    yield f"rotation of the hand by {component}, level {level} (degrees)", start.turned_deg(twin)


class RobotAxis(Axis):
    """Offsets of the arm's joints in all directions, with equal probability.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
        components: Components to sample, each entry with equal probability. The default has three entries
            ``controller_posture``, the benchmark's own component, and one entry ``initial_joints``.
        norm_rad: Norm of the offsets of ``controller_posture`` at each level, in rad; the benchmark's norms by default.
        initial_norm_rad: Norm of the offsets of ``initial_joints`` at each level, in rad. At the defaults, nine of ten
            hands start within 10 cm of their unchanged place, as in nearly all robot tests. At the benchmark's norms,
            half of them start further away.
    """

    kinds: ClassVar = (RobotPerturbation,)
    colour: ClassVar = "#129fc0"
    dimension: ClassVar = "robot"

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = (
        *("controller_posture", "controller_posture", "controller_posture"),
        "initial_joints",
    )
    norm_rad: ByLevel[Norm] = (0.1, 0.2, 0.3, 0.4, 0.5)
    initial_norm_rad: ByLevel[Norm] = (0.06, 0.1, 0.14, 0.18, 0.22)

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the level by the norm of the offset, 0.1 rad for each level."""
        return level_from(float(tested.parameters["id"]) / 100)

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> RobotPerturbation:
        level = self.sample_level(rng)
        component = pick(rng, self.components)
        direction = rng.standard_normal(7)
        norms_rad = self.initial_norm_rad if component == "initial_joints" else self.norm_rad
        offsets = direction * (norms_rad[level - 1] / np.linalg.norm(direction))
        return RobotPerturbation.model_validate(
            {"component": component, "level": level, "joint_offsets_rad": offsets.round(6).tolist()}
        )

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[RobotPerturbation]], test: TestSet) -> CoveragePlots:
        """Describe plots of the norms of the offsets, and of the offsets of each joint."""
        ids = [int(task.parameters["id"]) - 1 for task in test.on_axis("robot")]
        tested = benchmark_offsets_rad()[ids].reshape(-1, 7)
        offsets = np.array([item.perturbation.joint_offsets_rad for item in kept]).reshape(-1, 7)
        joints: dict[str, Groups] = {}
        for joint in range(7):
            joints[f"joint {joint + 1}"] = {BENCHMARK: np.unique(tested[:, joint]), "robot": offsets[:, joint]}
        norms = {BENCHMARK: np.linalg.norm(tested, axis=1), "robot": np.linalg.norm(offsets, axis=1)}
        return CoveragePlots(
            f"{len(ids):,} test tasks with {len(set(ids))} distinct offsets.",
            [
                Histogram("Norm of the joint offsets", norms, np.arange(0.025, 0.6, 0.05), "norm (rad)"),
                Strips("Offset of each joint, from base to wrist", joints, "rad"),
            ],
        )
