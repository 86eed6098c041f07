"""Reopen the datasets and the manifest of a finished run, as their readers would, and say what is off.

The datasets are compared with the stores that they were made from; those in turn are held against fresh renderings.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from operator import call
from pathlib import Path
from typing import Any

from pipeline.clients import oft
from pipeline.compute.pool import Workers
from pipeline.errors import PipelineError
from pipeline.files import read_json, scratch
from pipeline.formats import registry
from pipeline.formats.base import Format, Row
from pipeline.formats.read_back import Fault, Written
from pipeline.formats.rlds_layout import datasets
from pipeline.grouping import grouped
from pipeline.libero.tasks import find_task
from pipeline.physics.quality import measure
from pipeline.planning import selection
from pipeline.rendering.renderer import scene_of_process
from pipeline.run import outcome
from pipeline.run.counts import by_axis_and_suite
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.export import wordings
from pipeline.run.run import COUNTS, STATISTICS, WORK, Run
from pipeline.types import Extra
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.rerender import rendered, witnesses

WHOLE = 4
"""So many of the episodes that are rendered anew have all frames decoded, for the statistics of their views."""

SLICE = 16
"""So many episodes are checked in one call, where no scene has to be opened for them."""


@dataclass
class Results:
    """What checks came to, over any number of episodes.

    Attributes:
        checked: check to how often it was made.
        findings: check to what it found.
    """

    checked: Counter[str] = field(default_factory=Counter)
    findings: dict[str, list[Fault]] = field(default_factory=lambda: defaultdict(list))

    def note(self, check: str, found: Iterable[Fault], checked: int = 1) -> None:
        self.checked[check] += checked
        self.findings[check] += found

    def add(self, other: Results, within: str = "") -> None:
        """Take over what others came to; ``within`` comes before the names of their datasets."""
        for check, checked in other.checked.items():
            found = [replace(fault, dataset=within + fault.dataset) for fault in other.findings[check]]
            self.note(check, found, checked)


def validate(run: Run, workers: Workers) -> dict[str, Any]:
    """Check a finished run; memory holds one episode in each worker, and the manifest.

    Returns:
        JSON-serialisable: check to how many episodes (or planned rows, or datasets) were ``checked``, and
        ``findings``, each with ``dataset``, ``episode`` (None when it is about the whole), ``what`` and ``expected``.

    Raises:
        PipelineError: when the manifest or the stores cannot be read.
    """
    run = run.resolved()
    rows = run.manifest
    kept = {row["episode_id"]: row for row in rows if row["kept"]}
    total = Results()
    total.note("counts", _counts(run), len(rows))
    with scratch(run.path(WORK) / "validate") as cache:
        try:
            job = EpisodesJob(run, run.formats, cache, frozenset(witnesses(rows)))
            total.add(_datasets(job, kept, workers))
            missed = set(run.outcome.missed) if run.config.export.failures else set()
            if missed:
                failures = run.failure_formats
                places = registry.places(failures)
                failed = {}
                for row in rows:
                    episode_id = row["episode_id"]
                    if episode_id in missed:
                        failed[episode_id] = row | places.get(episode_id, {})
                job = EpisodesJob(run, failures, cache, frozenset([*failed][:1]), ("outcome",))
                total.add(_datasets(job, failed, workers), within=f"{registry.FAILURES}/")
        finally:
            scene_of_process().close()
    return {
        check: {"checked": checked, "findings": [asdict(finding) for finding in total.findings[check]]}
        for check, checked in total.checked.items()
    }


def _datasets(job: EpisodesJob, episodes: Mapping[str, Row], workers: Workers) -> Results:
    """The checks of some datasets, each as a whole, and of their episodes; ``job`` has all datasets."""
    total = Results()
    files = [file for one in job.formats for file in one.written()]
    for faults in workers(Written.faults, files, "checksums"):
        total.note("checksums", faults)
    # What changed files seem to hold is of no interest, and may be anything.
    changed = {fault.dataset for fault in total.findings["checksums"]}
    unchanged = [one for one in job.formats if one.name not in changed]
    # In workers, which read the episodes with the same packages later.
    closed = workers(_closed, unchanged, "open")
    total.note("readable", [fault for fault in closed if fault], 0)
    job = replace(job, formats=[one for one, fault in zip(unchanged, closed, strict=True) if not fault])
    # Together, and lerobot, which takes longest, before RLDS: the other workers go on with the episodes.
    work: list[Callable[[], Results]] = [
        partial(_as_a_whole, one, episodes, job.cache) for one in reversed(job.formats)
    ]
    if "outcome" not in job.extras and any(one.name == "rlds" for one in job.formats):
        statistics = read_json(job.run.path(STATISTICS))
        work += [partial(_openvla_oft, statistics, folder) for folder in datasets(job.run.dataset("rlds").folder)]
    work += [partial(job, rows) for rows in _slices(episodes, job.witnesses, job.formats)]
    for results in workers(call, work, "validate"):
        total.add(results)
    return total


def _closed(one: Format[Any]) -> Fault | None:
    try:
        one.open()
    except PipelineError as error:
        return _unreadable(one, error)
    return None


def _unreadable(one: Format[Any], error: PipelineError) -> Fault:
    return Fault(one.name, None, str(error), "a dataset that can be opened")


def _counts(run: Run) -> Iterator[Fault]:
    """Every planned row in the manifest; no quota overfilled, and none left open while candidates are left."""
    planned, rows = [row.episode_id for row in run.plan], run.manifest
    if planned != [row["episode_id"] for row in rows]:
        yield Fault("manifest", None, f"{len(rows)} rows", f"the {len(planned)} of the plan, in its order")
    quotas = grouped(((row["axis"], row["suite"], row["task"]), row) for row in rows)
    for (axis, suite, task), members in quotas.items():
        wanted = sum(row["wanted"] for row in members)
        kept = sum(row["reason"] in outcome.MADE for row in members)
        left = any(row["reason"] in (selection.NOT_NEEDED, selection.NOT_REPLAYED) for row in members)
        if kept > wanted or (kept < wanted and left):
            yield Fault("manifest", None, f"{kept} episodes of {axis} for {suite}/{task}", f"{wanted}")
    if read_json(run.path(COUNTS)) != by_axis_and_suite(rows):
        yield Fault("manifest", None, "counts.json does not follow from the rows", "the counts that do")


def _as_a_whole(one: Format[Any], episodes: Mapping[str, Row], cache: Path) -> Results:
    results, found = Results(), []
    try:
        for named in one.check(episodes, cache):
            found.append(named)
    except PipelineError as error:
        results.note("readable", [_unreadable(one, error)], 0)
    for check, checked in (("format", 1), ("ids", len(episodes)), ("splits", len(episodes)), ("readable", 0)):
        results.note(check, [fault for named, fault in found if named == check], checked)
    return results


def _openvla_oft(statistics: Mapping[str, Any], folder: Path) -> Results:
    try:
        wrong = oft.check(folder, statistics)["violations"]
    except PipelineError as error:
        wrong = [str(error)]  # The reader stops at what is damaged.
    results, name = Results(), folder.parent.name
    results.note(
        "openvla_oft", (Fault("rlds", None, f"{name}: {what}", "what OpenVLA-OFT trains on") for what in wrong)
    )
    return results


def _slices(kept: Mapping[str, Row], again: Collection[str], formats: Sequence[Format[Any]]) -> list[list[Row]]:
    """All episodes, those that are checked in one call together.

    Those to render anew come by trajectory and task, as those have a scene in common; the others as they lie in the
    datasets.
    """
    rows = sorted(kept.values(), key=lambda row: (row["suite"], row["task"]))
    by_trajectory = grouped((row["trajectory_id"], row) for row in rows if row["episode_id"] in again)
    others = [row for row in rows if row["episode_id"] not in again]
    # By LeRobot's files first, as theirs are the largest: the next episode lies in those that are open.
    columns = [column.name for one in reversed(formats) for column in one.columns]
    others.sort(key=lambda row: [(row[column] is None, row[column]) for column in columns])
    return [*by_trajectory.values(), *(others[start : start + SLICE] for start in range(0, len(others), SLICE))]


@dataclass(frozen=True)
class EpisodesJob:
    """The checks of some episodes, wherever they lie.

    Attributes:
        formats: the datasets that can be opened.
        cache: folder for files that reading them needs.
        witnesses: ids of the episodes to render anew.
        extras: ``outcome`` for failures.
    """

    run: Run
    formats: Sequence[Format[Any]]
    cache: Path
    witnesses: frozenset[str]
    extras: tuple[Extra, ...] = ()

    def __call__(self, rows: Sequence[Row]) -> Results:
        results, rewrites = Results(), None
        if any(one.language for one in self.formats):
            language = self.run.config.plan.axes.language
            rewrites = {row["episode_id"]: wordings(language, row["suite"], row["task"], row["axis"]) for row in rows}
        load = self.run.episodes(extras=self.extras, rewrites=rewrites)
        for row in rows:
            self._check(row, load, results)
        return results

    def _check(self, row: Row, load: EpisodeLoader, results: Results) -> None:
        episode_id = row["episode_id"]
        copies = []
        results.note("readable", [])
        for one in self.formats:
            try:
                if (copy := one.read(row, self.cache)) is not None:
                    copies.append(copy)
                else:
                    missing = Fault(one.name, episode_id, "is not in the dataset", "every kept episode")
                    results.note("ids", [missing], 0)
            except PipelineError as error:
                unreadable = Fault(one.name, episode_id, str(error), "an episode that can be read")
                results.note("readable", [unreadable], 0)
        try:
            made = load(episode_id)
            trajectory = self.run.trajectories.load(row["trajectory_id"])
        except PipelineError as error:
            results.note("stored", [Fault("frames", episode_id, str(error), "what the run made")])
            return
        results.note("stored", [])
        if "outcome" in self.extras:  # The manifest has figures of kept episodes alone.
            quality = measure(trajectory, find_task(row["suite"], row["task"]))
            row = {**row, **asdict(quality), "success": row["kept"]}
        language = self.run.config.plan.axes.language
        witness = episode_id in sorted(self.witnesses)[:WHOLE]
        case = Case(row, made, trajectory, copies, language.bank if language else None, witness)
        for name, check in CHECKS.items():
            results.note(name, check(case))
        if episode_id in self.witnesses:
            results.note("rendered", rendered(case, self.run.config.render, scene_of_process()))
