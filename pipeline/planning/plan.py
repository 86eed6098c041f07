"""The plan: a table with one row per wanted episode. All randomness is drawn here, keyed, never by position."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import count, islice
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
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.grouping import grouped
from pipeline.libero.demonstrations import DemoEntry
from pipeline.seeding import digest, rng
from pipeline.tables import read_table, write_table
from pipeline.testset.benchmark import TestSet
from pipeline.testset.own_tasks import reject_test_tasks
from pipeline.types import Task

_ATTEMPTS = 100

RESET = "reset"
"""What stands for the axis where nothing is perturbed and the start is a reset of LIBERO's environment."""


@dataclass(frozen=True)
class Row:
    """One candidate episode: the columns of the plan, which are the first of the manifest's, with what they mean."""

    episode_id: Annotated[str, "hash of demonstration, perturbations and replay settings; joins RLDS, LeRobot and this"]
    twin_id: Annotated[str, "episode of the same demonstration without perturbations; a twin's own id"]
    trajectory_id: Annotated[str, "the physics rendered; shared by episodes that differ in render, pixels or text"]
    role: Annotated[str, "twin or perturbed"]
    suite: Annotated[str, "suite of the task, LIBERO's or another"]
    task: Annotated[str, "name of the task in its suite"]
    demo_id: Annotated[str, "suite/task/key of the source demonstration"]
    demo_sha256: Annotated[str, "hash of the recorded content of the source demonstration"]
    demo_source: Annotated[str, "where the demonstration was published"]
    demo_origin: Annotated[str, "human, or expanded: made from a human demonstration by `demos expand`"]
    demo_origin_sha256: Annotated[str, "demo_sha256 of the human demonstration that it was made from, or its own"]
    demo_steps: Annotated[int, "recorded actions, no-ops included"]
    axis: Annotated[str, "perturbed axis, several joined by +, or clean"]
    component: Annotated[str, "component of the axis, several joined by +, or clean"]
    level: Annotated[str, "strength, 1 to 5, several joined by + in the order of component; 0 for a twin"]
    perturbations: Annotated[str, "JSON list with every parameter, deepest layer first"]
    instruction: Annotated[str, "the text that the policy is prompted with"]
    rank: Annotated[int, "place among the candidates of its axis and task"]
    wanted: Annotated[bool, "false for a reserve, used only where a candidate before it fails"]
    seed: Annotated[int, "the run's seed; with axis, demo_id and variant the key of the draw"]
    variant: Annotated[int, "how many draws of this axis this demonstration had before"]

    @property
    def reset_seed(self) -> int | None:
        """Of the reset of LIBERO's environment that the replay starts from; None where it starts as recorded."""
        if self.axis != RESET:
            return None
        return int(rng(self.seed, self.axis, self.demo_id, self.variant).integers(2**32))


def make(demos: Sequence[DemoEntry], plan: PlanConfig, replay: ReplayConfig, test: TestSet) -> list[Row]:
    """Draw the plan: a clean twin of every demonstration, then each axis's or combination's candidates, task by task.

    A draw that comes closer to one of the benchmark's ``test`` tasks than its axis allows is drawn anew. The benchmark
    perturbs one axis at a time, but so must each part of a combination keep clear.

    Raises:
        PipelineError: when there is nothing to plan from for an axis, or a level of it has no draw that keeps clear, or
            a task of one's own is a test task.
    """
    by_task = grouped((demo.task, demo) for demo in demos)
    reject_test_tasks(by_task)
    rows = [row for group in by_task.values() for row in twins(group, plan.seed, replay)]
    for name, episodes in plan.episodes.items():
        draws = Draws(name, plan.drawn_from(name), plan.seed, test)
        groups = [group for group in by_task.values() if all(axis.applies(group[0].task) for axis in draws.axes)]
        if not groups:
            raise PipelineError(
                "none of the chosen tasks has anything that this could change",
                where=f"plan.episodes.{name}",
                remedy="widen demos.tasks, or take it out of plan.episodes",
            )
        for axis in draws.axes:
            axis.refuse_tested(test, groups[0][0].task)
        # In an order of its own: or small numbers of all axes would come to the same tasks and demonstrations.
        order = sorted(groups, key=lambda group: digest(plan.seed, name, group[0].task.suite, group[0].task.name))
        more = order[: episodes % len(groups)]
        for group in groups:
            # Dealt out evenly; some tasks get one more where it does not divide.
            wanted = episodes // len(groups) + (group in more)
            dealt = sorted(group, key=lambda demo: digest(plan.seed, name, demo.demo_id))
            candidates = islice(_candidates(draws, dealt), wanted + ceil(wanted * plan.reserve))
            for rank, (demo, perturbations, variant) in enumerate(candidates):
                row = _row(demo, perturbations, plan.seed, replay)
                rows.append(replace(row, rank=rank, variant=variant, wanted=rank < wanted))
    return rows


def twins(demos: Sequence[DemoEntry], seed: int, replay: ReplayConfig) -> list[Row]:
    """The clean twin of each demonstration of a task."""
    return [replace(_row(demo, (), seed, replay), rank=rank) for rank, demo in enumerate(demos)]


def resets(demos: Sequence[DemoEntry], wanted: int, reserve: float, seed: int, replay: ReplayConfig) -> list[Row]:
    """The clean twin of each demonstration of a task, and candidates that start from resets, each one's in turn."""
    twins_of_task = twins(demos, seed, replay)
    rows = [*twins_of_task]
    for rank in range(wanted + ceil(wanted * reserve)):
        variant, number = divmod(rank, len(demos))
        row = replace(twins_of_task[number], role="perturbed", axis=RESET, component=RESET)
        row = replace(row, rank=rank, wanted=rank < wanted, variant=variant)
        name = digest(RESET, row.trajectory_id, row.reset_seed)[:16]
        rows.append(replace(row, episode_id=name, trajectory_id=name))
    return rows


def refuse_other_settings(rows: Sequence[Row], replay: ReplayConfig) -> None:
    """Refuse to replay by other settings than those that the ids stand for.

    Raises:
        PipelineError: when the plan was drawn under other settings of ``replay``.
    """
    if any(row.episode_id != _identity("episode", row.demo_sha256, replay, row.perturbations) for row in rows):
        raise PipelineError(
            "the section replay has changed since the plan",
            remedy=f"`{MAKE_AGAIN}`, which plans again; or put the section back",
        )


def demonstrations(rows: Sequence[Row]) -> dict[str, int]:
    """Suite to the number of demonstrations of its task that has most of them; all that have one origin count once."""
    most: dict[str, int] = {}
    origins = {(row.suite, row.task, row.demo_origin_sha256) for row in rows if row.role == "twin"}
    for (suite, _), number in Counter((suite, task) for suite, task, _ in origins).items():
        most[suite] = max(number, most.get(suite, 0))
    return most


def shortage(rows: Sequence[Row], plan: PlanConfig) -> dict[str, int]:
    """Axis or combination to the number of wanted episodes that no different draw was left for, where there are any."""
    there = Counter(row.axis for row in rows if row.wanted)
    return {axis: wanted - there[axis] for axis, wanted in plan.episodes.items() if wanted != there[axis]}


class Dealt:
    """How often the candidates of one task have each entry of the lists that its axes take perturbations from.

    A candidate takes one of the entries that fewest candidates before it have. Which of these is the choice of its key.
    So all entries come once before one comes again, and another demonstration changes few of the others' entries.
    """

    def __init__(self) -> None:
        self._times: Counter[str] = Counter()

    def in_turn(self, entries: Sequence[str], key: str) -> list[int]:
        """The places of the entries in the order in which a candidate takes them; a single place for an empty list."""
        if not entries:
            return [0]
        return sorted(range(len(entries)), key=lambda place: (self._times[entries[place]], digest(key, entries[place])))

    def give(self, entries: Sequence[str], place: int) -> None:
        """Count the entry that a candidate has."""
        if entries:
            self._times[entries[place]] += 1


@dataclass(frozen=True)
class Draws:
    """What a plan draws for its episodes of one axis or combination.

    Attributes:
        name: of the axis or combination, as in ``plan.episodes``.
        axes: what it draws from.
        seed: of the plan.
        test: the benchmark's tasks, of which draws keep clear.
    """

    name: str
    axes: Sequence[Axis]
    seed: int
    test: TestSet

    def of(
        self, demo_id: str, task: Task, dealt: Dealt | None = None, expanded_by: str = "[]"
    ) -> Iterator[tuple[Perturbation, ...]]:
        """Sample for one demonstration, variant after variant: all different, and clear of the test set.

        Args:
            dealt: the entries of lists that other demonstrations of the task have; by default none.
            expanded_by: JSON of the perturbations by which an expansion made the demonstration.

        Yields:
            One perturbation of each axis, until no different draw is left.

        Raises:
            PipelineError: when another version with other perturbations made the demonstration.
        """
        earlier = _earlier(demo_id, expanded_by)
        dealt = dealt or Dealt()
        drawn: set[tuple[str, ...]] = set()
        for variant in count():
            key = (demo_id, variant)
            turns = [dealt.in_turn(axis.entries(task), digest(self.seed, self.name, *key)) for axis in self.axes]
            for attempt in range(_ATTEMPTS):
                places = [places_of_axis[attempt % len(places_of_axis)] for places_of_axis in turns]
                perturbations = self._sampled(task, places, earlier, (*key, attempt))
                content = tuple(one.model_dump_json() for one in perturbations or ())
                if perturbations and content not in drawn:
                    break
            else:
                return
            drawn.add(content)
            for axis, place in zip(self.axes, places, strict=True):
                dealt.give(axis.entries(task), place)
            yield perturbations

    def _sampled(
        self, task: Task, places: Sequence[int], earlier: Sequence[Perturbation], key: tuple[str | int, ...]
    ) -> tuple[Perturbation, ...] | None:
        """One perturbation of each axis, ``None`` where one of them finds none that is clear."""
        random = rng(self.seed, self.name, *key)
        # All from one generator, before any is drawn anew from one of its own.
        sampled = [
            axis.sample(random, task, place).after(earlier) for axis, place in zip(self.axes, places, strict=True)
        ]
        instruction = " ".join(one.apply("") for one in sampled if isinstance(one, TextPerturbation))
        perturbations = []
        for number, (first, axis) in enumerate(zip(sampled, self.axes, strict=True)):
            clear = self._clear(first, axis, task, instruction, earlier, (*key, number))
            if clear is None:
                return None
            perturbations.append(clear)
        return tuple(perturbations)

    def _clear(
        self,
        first: Perturbation,
        axis: Axis,
        task: Task,
        instruction: str,
        earlier: Sequence[Perturbation],
        key: tuple[str | int, ...],
    ) -> Perturbation | None:
        """The ``first`` draw of an axis where it is clear, else another of its component and level.

        Or strengths near the test set's would become rare. None where none of many is clear: far enough from the test
        set, and not named by the ``instruction``. A list has its next entry for that.
        """

        def clear(one: Perturbation) -> bool:
            return one.nearest(self.test, task).distance >= one.clearance and not one.named_in(instruction)

        if clear(first):
            return first
        if axis.entries(task):
            return None
        again, alike = rng(self.seed, self.name, *key), axis.model_copy(update={"levels": (first.level,)})
        for _ in range(_ATTEMPTS):
            one = alike.sample(again, task, 0).after(earlier)
            if (one.component, one.level) == (first.component, first.level) and clear(one):
                return one
        return None


def _earlier(demo_id: str, expanded_by: str) -> tuple[Perturbation, ...]:
    """Read the perturbations by which an expansion made a demonstration.

    Raises:
        PipelineError: when another version with other perturbations made it.
    """
    try:
        return tuple(from_json(expanded_by))
    except PipelineError as error:
        raise PipelineError(
            f"the perturbations of this expanded demonstration cannot be read ({error.what})",
            where=demo_id,
            expected="perturbations of this version",
            remedy="expand the human demonstrations again into another folder",
        ) from error


def _candidates(draws: Draws, group: Sequence[DemoEntry]) -> Iterator[tuple[DemoEntry, tuple[Perturbation, ...], int]]:
    """A task's candidates and their variants: every demonstration's first variant, then every second one, and so on.

    A demonstration of which no more different draws are left that keep clear of the test set is passed over; the
    candidates end when none is left of any.
    """
    dealt = Dealt()
    left = {demo: draws.of(demo.demo_id, demo.task, dealt, demo.perturbations) for demo in group}
    for variant in count():
        for demo, drawn in [*left.items()]:
            if (perturbations := next(drawn, None)) is None:
                del left[demo]
            else:
                yield demo, perturbations, variant
        if not left:
            return


def _row(demo: DemoEntry, perturbations: Sequence[Perturbation], seed: int, replay: ReplayConfig) -> Row:
    """A wanted episode, the first of its kind."""
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
    return digest(kind, demo_sha256, replay.model_dump(), perturbations)[:16]


def write(rows: Sequence[Row], path: Path) -> None:
    table = pa.table({column.name: [getattr(row, column.name) for row in rows] for column in fields(Row)})
    write_table(table, path)


def read(path: Path) -> list[Row]:
    """Read a plan back.

    Raises:
        PipelineError: when it is missing, damaged or not a plan of this version.
    """
    names = [column.name for column in fields(Row)]
    columns = read_table(path, names, MAKE_AGAIN).select(names).to_pydict()
    return [Row(*row) for row in zip(*columns.values(), strict=True)]
