"""Plan: a table with one row per candidate episode. All random numbers are sampled here, by key, never by position."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Annotated

import pyarrow as pa

from pipeline.axes import (
    Axis,
    Perturbation,
    PhysicsPerturbation,
    TextPerturbation,
    from_json,
    in_order,
    of_layer,
    to_json,
)
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.errors import MAKE_AGAIN, RUN_AGAIN, PipelineError
from pipeline.grouping import grouped
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning.apportion import apportion
from pipeline.planning.sampler import Sampler, sample_candidates
from pipeline.seeding import digest, rng
from pipeline.tables import read_table, write_table
from pipeline.testset.benchmark import TestSet, is_in_tested_scene
from pipeline.testset.own_tasks import reject_test_tasks
from pipeline.types import Task

RESET = "reset"
"""Name in the column ``axis`` of unperturbed episodes that start from a reset of LIBERO's environment."""


@dataclass(frozen=True)
class Row:
    """Candidate episode: the columns of the plan, which are the first columns of the manifest, with their meanings."""

    episode_id: Annotated[
        str, "hash of demonstration, perturbations and replay settings; joins RLDS, LeRobot and the manifest"
    ]
    twin_id: Annotated[str, "episode_id of the clean twin; of a clean twin, its own episode_id"]
    trajectory_id: Annotated[
        str, "rendered trajectory; episodes that differ only in render, pixel or text layers share it"
    ]
    role: Annotated[str, "twin or perturbed"]
    suite: Annotated[str, "suite of the task, LIBERO's or another"]
    task: Annotated[str, "name of the task in its suite"]
    demo_id: Annotated[str, "suite/task/key of the source demonstration"]
    demo_sha256: Annotated[str, "hash of the recorded content of the source demonstration"]
    demo_source: Annotated[str, "file or published source of the demonstration, and its name in it"]
    demo_origin: Annotated[str, "human, or expanded: generated from a human demonstration by `demos expand`"]
    demo_origin_sha256: Annotated[str, "demo_sha256 of the human demonstration behind an expanded one, else its own"]
    demo_steps: Annotated[int, "recorded actions, no-ops included"]
    axis: Annotated[str, "perturbed axis, several joined by +, or clean"]
    component: Annotated[str, "component of the axis, several joined by +, or clean"]
    level: Annotated[str, "strength, 1 to 5, several joined by + in the order of component; 0 for a clean twin"]
    perturbations: Annotated[
        str, "JSON list with every parameter, deepest layer first; gaussian_blur has its former name gaussian"
    ]
    instruction: Annotated[str, "the text that the policy is prompted with"]
    rank: Annotated[int, "place among the candidates of its axis and task"]
    wanted: Annotated[bool, "false for a reserve, which is used only if another candidate fails"]
    seed: Annotated[int, "seed of the run; with axis, demo_id and variant, the key of the perturbations"]
    variant: Annotated[int, "number of earlier samples of this axis for this demonstration"]

    @property
    def reset_seed(self) -> int | None:
        """Seed of the reset of LIBERO's environment that starts the replay; ``None`` if it starts as recorded."""
        if self.axis != RESET:
            seeds = (perturbation.reset_seed for perturbation in from_json(self.perturbations))
            return next((seed for seed in seeds if seed is not None), None)
        return int(rng(self.seed, self.axis, self.demo_id, self.variant).integers(2**32))


def make(demos: Sequence[DemoEntry], plan: PlanConfig, replay: ReplayConfig, test: TestSet) -> list[Row]:
    """Sample the plan: a clean twin of every demonstration, then each axis's or combination's candidates, task by task.

    A perturbation that comes closer to one of the benchmark's ``test`` tasks than its clearance is sampled again. The
    benchmark perturbs one axis at a time, but each part of a combination must keep its clearance too. An axis that is
    configured to keep no clearance (``Axis.keeps_clearance``) is left as sampled.

    Raises:
        PipelineError: when an axis applies to none of the tasks, or a level has no perturbation that keeps its
            clearance; also when a task of the user's own is a test task.
    """
    by_task = grouped((demo.task, demo) for demo in demos)
    reject_test_tasks(by_task)
    rows: list[Row] = []
    for group in by_task.values():
        rows += twins(group, plan.seed, replay)
    for name in plan.episodes:
        rows += _plan_entry(name, by_task, plan, replay, test)
    return rows


def _plan_entry(
    name: str, by_task: Mapping[Task, Sequence[DemoEntry]], plan: PlanConfig, replay: ReplayConfig, test: TestSet
) -> list[Row]:
    """Sample the candidates of one entry of ``plan.episodes``, task by task.

    Raises:
        PipelineError: as ``make``, but for the user's tasks.
    """
    sampler = Sampler(name, plan.axes_for(name), plan.seed, test)
    demos_of = {task: demos for task, demos in by_task.items() if _all_apply(sampler.axes, task)}
    if not demos_of:
        raise PipelineError(
            "none of the selected tasks has a thing that these axes can change at their levels and components",
            where=f"plan.episodes.{name}",
            remedy="add tasks to demos.tasks, add levels or components to plan.axes, or remove the entry",
        )
    # Tasks of one suite differ if the benchmark tests some of their scenes only.
    alike = grouped(((task.suite, is_in_tested_scene(task)), task) for task in demos_of)
    for axis in sampler.axes:
        for tasks in alike.values():
            axis.reject_levels_without_clearance(test, tasks[0])
    # Each axis has its own order. Else small numbers of episodes would use the same tasks on all axes.
    ordered = sorted(demos_of, key=lambda task: digest(plan.seed, name, task.suite, task.name))
    weights = [plan.task_weights.get(str(task), 1.0) for task in ordered]
    wanted_of = dict(zip(ordered, apportion(plan.episodes[name], weights), strict=True))
    rows: list[Row] = []
    for task, demos in demos_of.items():
        wanted = wanted_of[task]
        shuffled = sorted(demos, key=lambda demo: digest(plan.seed, name, demo.demo_id))
        candidates = islice(sample_candidates(sampler, shuffled), wanted + ceil(wanted * plan.reserve))
        for rank, (demo, perturbations, variant) in enumerate(candidates):
            candidate = build_row(demo, perturbations, plan.seed, replay)
            rows.append(replace(candidate, rank=rank, variant=variant, wanted=rank < wanted))
    return rows


def _all_apply(axes: Sequence[Axis], task: Task) -> bool:
    """Return whether all axes can change ``task``."""
    return all(axis.applies(task) for axis in axes)


def twins(demos: Sequence[DemoEntry], seed: int, replay: ReplayConfig) -> list[Row]:
    """Return the clean twin of each demonstration of a task."""
    return [replace(build_row(demo, (), seed, replay), rank=rank) for rank, demo in enumerate(demos)]


def resets(demos: Sequence[DemoEntry], wanted: int, reserve: float, seed: int, replay: ReplayConfig) -> list[Row]:
    """Return the clean twin of each demonstration of a task, and candidates that start from resets.

    The demonstrations take turns in providing candidates.

    Args:
        wanted: number of wanted episodes.
        reserve: share of further candidates.
    """
    twins_of_task = twins(demos, seed, replay)
    rows = [*twins_of_task]
    for rank in range(wanted + ceil(wanted * reserve)):
        variant, number = divmod(rank, len(demos))
        row = replace(twins_of_task[number], role="perturbed", axis=RESET, component=RESET)
        row = replace(row, rank=rank, wanted=rank < wanted, variant=variant)
        name = digest(RESET, row.trajectory_id, row.reset_seed)[:16]
        rows.append(replace(row, episode_id=name, trajectory_id=name))
    return rows


def reject_other_settings(rows: Sequence[Row], replay: ReplayConfig) -> None:
    """Reject replay settings that differ from the settings in the ids.

    Raises:
        PipelineError: when the plan was sampled under other settings of ``replay``.
    """
    for row in rows:
        if row.episode_id != _identity("episode", row.demo_sha256, replay, row.perturbations):
            raise PipelineError(
                "the section replay has changed since the plan",
                where="replay",
                expected="the settings with which the plan was sampled",
                remedy=f"run `{MAKE_AGAIN}`, which plans again; or restore the section",
            )


def count_demonstrations(rows: Sequence[Row]) -> dict[str, int]:
    """Count the demonstrations of the task with most demonstrations, for each suite.

    Demonstrations of one origin count once.
    """
    most: dict[str, int] = {}
    origins = {(row.suite, row.task, row.demo_origin_sha256) for row in rows if row.role == "twin"}
    per_task = Counter((suite, task) for suite, task, _ in origins)
    for (suite, _), number in per_task.items():
        most[suite] = max(number, most.get(suite, 0))
    return most


def shortage(rows: Sequence[Row], plan: PlanConfig) -> dict[str, int]:
    """Count the wanted episodes that the plan lacks because no different perturbation was left.

    Returns:
        Axis or combination to the number of missing episodes; axes without missing episodes are left out.
    """
    planned = Counter(row.axis for row in rows if row.wanted)
    return {axis: wanted - planned[axis] for axis, wanted in plan.episodes.items() if wanted != planned[axis]}


def build_row(demo: DemoEntry, perturbations: Sequence[Perturbation], seed: int, replay: ReplayConfig) -> Row:
    """Build the row of a wanted episode, with rank and variant 0."""
    perturbations = in_order(perturbations)
    physics = to_json(of_layer(perturbations, PhysicsPerturbation))
    listed = to_json(perturbations)
    instruction = demo.task.instruction
    for change in of_layer(perturbations, TextPerturbation):
        instruction = change.apply(instruction)
    return Row(
        episode_id=_identity("episode", demo.sha256, replay, listed),
        twin_id=_identity("episode", demo.sha256, replay, "[]"),
        trajectory_id=_identity("trajectory", demo.sha256, replay, physics),
        role="perturbed" if perturbations else "twin",
        suite=demo.task.suite,
        task=demo.task.name,
        demo_id=demo.demo_id,
        demo_sha256=demo.sha256,
        demo_source=demo.source,
        demo_origin=demo.origin,
        demo_origin_sha256=demo.expanded_from_sha256 or demo.sha256,
        demo_steps=demo.steps,
        axis="+".join(p.axis for p in perturbations) or "clean",
        component="+".join(p.component for p in perturbations) or "clean",
        level="+".join(str(p.level) for p in perturbations) or "0",
        perturbations=listed,
        instruction=instruction,
        rank=0,
        wanted=True,
        seed=seed,
        variant=0,
    )


@lru_cache(maxsize=4096)
def _identity(kind: str, demo_sha256: str, replay: ReplayConfig, perturbations: str) -> str:
    """Hash the content that identifies an episode or a trajectory, 16 hexadecimal digits."""
    return digest(kind, demo_sha256, replay.model_dump(), perturbations)[:16]


def write(rows: Sequence[Row], path: Path) -> None:
    """Write a plan as a table."""
    columns = {}
    for column in fields(Row):
        columns[column.name] = [getattr(row, column.name) for row in rows]
    write_table(pa.table(columns), path)


def read(path: Path) -> list[Row]:
    """Read a plan from its table.

    Raises:
        PipelineError: when the file is missing, damaged or not a plan of this version.
    """
    names = [column.name for column in fields(Row)]
    columns = read_table(path, names, RUN_AGAIN).select(names).to_pydict()
    return [Row(*row) for row in zip(*columns.values(), strict=True)]
