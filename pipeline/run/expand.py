"""Expanded demonstrations, with other starts of the arm and other object poses, in LIBERO's own HDF5 layout.

An expansion replaces the hub's 50 demonstrations of each task if the hub cannot be reached. It generates many
demonstrations from the starter set's one human demonstration, with the planner and the replay of the datasets. All
files and datasets mark them as expanded.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from pipeline import outputs
from pipeline.axes import Axes
from pipeline.axes.pose import PoseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.catalogue.scene_files import portable
from pipeline.compute.pool import LOST, Workers
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.files import remove
from pipeline.grouping import grouped
from pipeline.identity import DISTRIBUTION, REMAKE, remake_allowed, require_remake_permission
from pipeline.libero import bddl, hdf5
from pipeline.libero.demonstrations import DemoEntry
from pipeline.libero.tasks import find_task
from pipeline.physics.quality import smoothness
from pipeline.planning import plan, selection
from pipeline.run.replay_stage import Replays
from pipeline.scenes.compiled import CompiledScene, compile_for_physics, proprioception
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Scene, State, Task, Trajectory

RESERVE = 2.0
"""Share of additional candidates, as colliding poses are rejected and some replays fail."""

START_NORM_RAD = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Norms of the offsets of the arm's start, by level; by default larger for a demonstration than for an episode."""

ROUGH = {"steps": 1.5, "path_m": 1.5, "jerk_rms_m_s3": 2.0}
"""Largest multiples of the human's episode length, path length and jerk that count as smooth."""

APART_RAD, APART_M = 0.05, 0.005
"""Two demonstrations of a task are duplicates if their arms and all their objects start closer than this."""

REPLAY = ReplayConfig(mode="auto", noops="keep", settle_steps=0)
"""Replay settings that keep no-ops and do not settle first, as in LIBERO's files. Readers of the files do both."""


@dataclass
class Expansion:
    """Result of an expansion.

    Attributes:
        files: files that were written.
        written: number of demonstrations in them.
        dropped: reason to number of candidates.
        short: task to the number of wanted demonstrations for which no candidate was left.
    """

    files: list[Path] = field(default_factory=list)
    written: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    short: dict[str, int] = field(default_factory=dict)


def expand(out: Path, demos: DemosConfig, rows: Sequence[plan.Row], per_task: int, workers: Workers) -> Expansion:
    """Generate ``per_task`` demonstrations of each task, and write them to ``<out>/<suite>/<task>_demo.hdf5``.

    A candidate is kept if it reaches the goal, moves about as smoothly as the human, and has another start than the
    candidates before it. Replays are stored in ``<out>/.replays``, so that a stopped expansion resumes. The files of an
    earlier expansion are replaced. If they have demonstrations that the new files lack, this needs ``REMAKE=1``.

    Args:
        demos: demonstrations that the candidates perturb.
        rows: plan of ``candidates`` or ``resets`` for the same ``per_task``.

    Raises:
        PipelineError: when a demonstration cannot be read, or finished replays would be generated again without
            permission. Also when a file would be replaced that is edited or has other demonstrations, and without
            permission, when expanded demonstrations would be deleted.
    """
    file_of = {entry.task: hdf5.demo_file(out, entry.task) for entry in demos.index().entries}
    for file in file_of.values():
        _reject_other_demonstrations(file)
        outputs.reject_other_file(file)
    if not remake_allowed():
        # The same check of kept rows comes after hours of replays.
        candidates = grouped((f"{row.suite}/{row.task}", row) for row in rows if row.role == "perturbed")
        for task, file in file_of.items():
            _reject_loss(file, candidates.get(str(task), []))
    store = TrajectoryStore(out / ".replays")
    require_remake_permission(store.outdated({row.trajectory_id for row in rows}), store.root)
    faults: dict[str, str] = {}
    while True:
        verdicts = Replays(demos, REPLAY, store, workers).complete(rows, faults)
        outcome = selection.select(rows, verdicts, faults)
        kept = [row for row in rows if row.role == "perturbed" and outcome[row.episode_id].kept]
        new_faults = _faults(kept, rows, store)
        if not new_faults:
            break
        faults |= new_faults
    not_dropped = {"kept", selection.NOT_NEEDED}
    reasons = [outcome[row.episode_id].reason for row in rows if row.role == "perturbed"]
    result = Expansion(dropped=Counter(reason for reason in reasons if reason not in not_dropped))
    by_task = grouped((f"{row.suite}/{row.task}", row) for row in kept)
    for task, file in file_of.items():
        _reject_loss(file, by_task.get(str(task), []))
    for task, file in file_of.items():
        rows_of_task = by_task.get(str(task), [])
        if len(rows_of_task) < per_task:
            result.short[str(task)] = per_task - len(rows_of_task)
        if rows_of_task:
            with outputs.written(file) as temporary:
                hdf5.write(temporary, task, (_recording(store.load(row.trajectory_id), row) for row in rows_of_task))
            result.files.append(file)
            result.written += len(rows_of_task)
        else:
            remove(file)
    return result


def _reject_other_demonstrations(file: Path) -> None:
    if not file.exists():
        return
    expanded = hdf5.expansions(file)
    if not expanded or None in expanded:
        raise PipelineError(
            "the file contains demonstrations that no expansion generated, and would be replaced",
            where=file,
            expected="no file, or a file of an earlier expansion",
            remedy="expand into another folder",
        )


def _reject_loss(file: Path, rows: Sequence[plan.Row]) -> None:
    """Stop before demonstrations of an earlier expansion are deleted, unless ``REMAKE=1`` allows it.

    Args:
        rows: rows of the demonstrations to write.
    """
    if not file.exists():
        return
    lost = {*hdf5.expansions(file)} - {hdf5.Expanded(row.perturbations, _reset_seed(row)) for row in rows}
    if not lost:
        return
    if remake_allowed():
        print(f"replaced {len(lost)} demonstrations in {file}")
        return
    raise PipelineError(
        f"{len(lost)} demonstrations of an earlier expansion would be deleted",
        where=file,
        expected="the options of the earlier call, or a larger --per-task that keeps all of its demonstrations",
        remedy=f"expand into another folder, or put `{REMAKE}=1` before the command",
    )


def _reset_seed(row: plan.Row) -> str | None:
    """Return the seed of a row's reset as the file has it; `None` for a start that is no reset."""
    return None if row.reset_seed is None else str(row.reset_seed)


def candidates(demos: DemosConfig, per_task: int, seed: int, test: TestSet) -> list[plan.Row]:
    """Plan candidates for ``expand`` in which the arm, and the objects that the task moves, start at other places.

    The arm's start differs in every candidate. If the task moves an object, the object's pose changes too. If this
    object stands on or in another object, the whole scene moves. If the task only opens or turns a thing, only the
    arm's start changes.
    """
    by_moved: dict[Literal["target", "scene"] | None, list[DemoEntry]] = defaultdict(list)
    for entry in demos.index().entries:
        definition = bddl.read(entry.task.bddl_file)
        carried = any(definition.carriers[name] != name for name in definition.targets)
        moved_by_task: Literal["target", "scene"] | None = None
        if definition.targets:
            moved_by_task = "scene" if carried else "target"
        by_moved[moved_by_task].append(entry)
    rows: list[plan.Row] = []
    for moved, group in by_moved.items():
        pose = PoseAxis(components=(moved,)) if moved else None
        robot = RobotAxis(components=("initial_joints",), initial_norm_rad=START_NORM_RAD)
        axes = Axes(pose=pose, robot=robot)
        tasks = {entry.task for entry in group}
        episodes = {"+".join(axes.configured()): per_task * len(tasks)}
        rows += plan.make(group, PlanConfig(seed=seed, axes=axes, episodes=episodes, reserve=RESERVE), REPLAY, test)
    return rows


def resets(demos: DemosConfig, per_task: int, seed: int) -> list[plan.Row]:
    """Plan candidates for ``expand`` that start like LIBERO's recordings: from a reset of its environment."""
    by_task = grouped((entry.task, entry) for entry in demos.index().entries)
    rows: list[plan.Row] = []
    for entries in by_task.values():
        rows += plan.resets(entries, per_task, RESERVE, seed, REPLAY)
    return rows


def _faults(rows: Sequence[plan.Row], planned: Sequence[plan.Row], store: TrajectoryStore) -> dict[str, str]:
    """Map episode ids to the faults of replays that reached their goals; replays without a fault are left out."""
    twins = {row.demo_id: row.trajectory_id for row in planned if row.role == "twin"}
    reasons = {trajectory_id: row["reason"] for trajectory_id, row in store.rows().items()}
    accepted: dict[tuple[str, str], list[_Motion]] = defaultdict(list)
    faults: dict[str, str] = {}
    for row in rows:
        task, before = find_task(row.suite, row.task), accepted[row.suite, row.task]
        motion, twin = _motion(store, row.trajectory_id, task), twins[row.demo_id]
        # A clean twin over which workers were lost has no motion to compare with.
        human = motion if reasons[twin] == LOST else _motion(store, twin, task)
        if any(motion.smoothness[name] > limit * human.smoothness[name] for name, limit in ROUGH.items()):
            faults[row.episode_id] = "not_smooth"
        elif any(motion.starts_like(earlier) for earlier in before):
            faults[row.episode_id] = "duplicate"
        else:
            before.append(motion)
    return faults


@dataclass(frozen=True)
class _Motion:
    """Measures by which candidates are compared.

    Attributes:
        smoothness: result of ``quality.smoothness``.
        joints_rad: (7,) start of the arm.
        objects_m: (N, 3) start positions of the objects.
    """

    smoothness: Mapping[str, float]
    joints_rad: Floats
    objects_m: Floats

    def starts_like(self, other: _Motion) -> bool:
        turned = np.linalg.norm(self.joints_rad - other.joints_rad)
        moved = np.linalg.norm(self.objects_m - other.objects_m, axis=1).max(initial=0.0)
        return bool(turned < APART_RAD and moved < APART_M)


@cache
def _motion(store: TrajectoryStore, trajectory_id: str, task: Task) -> _Motion:
    trajectory = store.load(trajectory_id)
    model = compile_for_physics(trajectory.model_xml)
    qpos = State.of(trajectory.states[0], model.nq).qpos
    free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    # A state begins with the arm's seven joints.
    return _Motion(smoothness(trajectory, task), qpos[:7], qpos[free[:, None] + np.arange(3)])


def _recording(trajectory: Trajectory, row: plan.Row) -> hdf5.Recording:
    """Convert a replay to a recording in LIBERO's layout, with its origin, but without images and this machine's paths.

    States precede each action, and observations follow it, as in LIBERO's files.
    """
    compiled = CompiledScene(Scene(trajectory.model_xml, trajectory.states[0]))
    robot, hands, joints = [], [], []
    for flattened in trajectory.states[1:]:
        compiled.restore(flattened)
        hand, arm = proprioception(compiled.data)
        w, *xyz = compiled.data.body("robot0_right_hand").xquat
        robot.append([*hand[6:], *hand[:3], *xyz, w])
        hands.append(hand)
        joints.append(arm)
    hand_states = np.array(hands, np.float64)
    return hdf5.Recording(
        actions=trajectory.actions,
        states=trajectory.states[:-1],
        robot_states=np.array(robot, np.float64),
        model_file=portable(trajectory.model_xml),
        obs=hdf5.proprioception(hand_states, np.array(joints, np.float64)),
        attrs={
            hdf5.EXPANDED_FROM: row.demo_id,
            hdf5.EXPANDED_FROM_SHA256: row.demo_sha256,
            hdf5.ORIGIN_SHA256: row.demo_origin_sha256,
            hdf5.EXPANDED_BY: f"{DISTRIBUTION} {version(DISTRIBUTION)}",
            "perturbations": row.perturbations,
            "resolved": trajectory.resolved,
            "replay_mode": trajectory.mode,
            **({} if row.reset_seed is None else {"reset_seed": _reset_seed(row)}),
        },
    )
