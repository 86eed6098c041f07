"""Validation of a finished run: its datasets and its manifest are opened again as their readers would open them.

The datasets are compared with the stores that they were generated from, and the stores with fresh renderings.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import chain
from operator import call
from pathlib import Path
from typing import Any

from pipeline.axes import task_of
from pipeline.clients import oft
from pipeline.compute.pool import Workers
from pipeline.errors import PipelineError
from pipeline.export_config import FAILURES
from pipeline.files import read_json, scratch
from pipeline.formats import registry, rlds_layout
from pipeline.formats.base import Format, ManifestRow
from pipeline.formats.read_back import Fault, Written
from pipeline.grouping import grouped
from pipeline.physics.quality import measure
from pipeline.planning import plan, selection
from pipeline.rendering.renderer import scene_of_process
from pipeline.run import outcome
from pipeline.run.counts import by_axis_and_suite
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.layout import COUNTS, STATISTICS, WORK
from pipeline.run.progress import has_frames
from pipeline.run.rewrites import list_episode_rewrites
from pipeline.run.run import Run
from pipeline.stores.frame_store import frames_by_trajectory
from pipeline.types import Quality
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.rerender import choose_rerendered, compare_frames, compare_subtasks

FULLY_DECODED = 4
"""Number of re-rendered episodes of which all frames are decoded, for the statistics of their views."""

SLICE = 16
"""Number of episodes that are checked in one call if no scene has to be opened for them."""


@dataclass
class Results:
    """The results of checks, over any number of episodes.

    Attributes:
        checked: check to the number of times that it compared anything.
        findings: check to the errors that it found.
    """

    checked: Counter[str] = field(default_factory=Counter)
    findings: dict[str, list[Fault]] = field(default_factory=lambda: defaultdict(list))

    def note(self, check: str, found: Iterable[Fault], checked: int = 1) -> None:
        self.checked[check] += checked
        self.findings[check] += found

    def add(self, other: Results, within: str = "") -> None:
        """Add other results; ``within`` is put in front of the names of their datasets."""
        for check, checked in other.checked.items():
            faults = [replace(fault, dataset=within + fault.dataset) for fault in other.findings[check]]
            self.note(check, faults, checked)


def validate(run: Run, workers: Workers) -> dict[str, Any]:
    """Check a finished run; memory holds one episode in each worker, and the manifest.

    Returns:
        JSON-serialisable: for each check, the number of episodes (or planned rows, or datasets) that were ``checked``,
        and ``findings``. Each finding has ``dataset``, ``episode`` (`None` if it is about the whole), ``what`` and
        ``expected``.

    Raises:
        PipelineError: when the manifest or the stores cannot be read.
    """
    run = run.resolved()
    rows = run.manifest
    kept = {row["episode_id"]: row for row in rows if row["kept"]}
    total = Results()
    total.note("counts", _counts(run), len(rows))
    total.note("plan", _unlike_plan(run), len(rows))
    total.note("stores", _unlike_stores(run), len(rows))
    with scratch(run.path(WORK) / "validate") as cache:
        try:
            job = EpisodesJob(run, run.datasets, cache, frozenset(choose_rerendered(rows)))
            total.add(_check_datasets(job, kept, workers))
            failed = _failed_rows(run)
            if failed:
                job = EpisodesJob(run, run.failure_datasets, cache, frozenset([*failed][:1]), of_failures=True)
                total.add(_check_datasets(job, failed, workers), within=f"{FAILURES}/")
        finally:
            scene_of_process().close()
    report = {}
    for check, checked in total.checked.items():
        report[check] = {"checked": checked, "findings": [asdict(fault) for fault in total.findings[check]]}
    return report


def _failed_rows(run: Run) -> dict[str, ManifestRow]:
    """Map the id of each written failure to its row of the manifest, with its places in the datasets of failures."""
    failures = set(run.outcome.failures) if run.config.export.failures else set()
    if not failures:
        return {}
    places = registry.places(run.failure_datasets)
    failed: dict[str, ManifestRow] = {}
    for row in run.manifest:
        episode_id = row["episode_id"]
        if episode_id in failures:
            failed[episode_id] = row | places.get(episode_id, {})
    return failed


def _check_datasets(job: EpisodesJob, episodes: Mapping[str, ManifestRow], workers: Workers) -> Results:
    """Check datasets, each as a whole, and their episodes; ``job`` has all datasets."""
    total = Results()
    files = list(chain.from_iterable(dataset.written() for dataset in job.datasets))
    for faults in workers(Written.faults, files, "checksums"):
        total.note("checksums", faults)
    # Datasets with changed files are not checked further, as their content may be anything.
    changed = {fault.dataset for fault in total.findings["checksums"]}
    unchanged = [dataset for dataset in job.datasets if dataset.name not in changed]
    # Workers open the datasets, because they read the episodes with the same packages later.
    open_faults = workers(_find_open_fault, unchanged, "open")
    total.note("readable", [fault for fault in open_faults if fault], 0)
    job = replace(job, datasets=[dataset for dataset, fault in zip(unchanged, open_faults, strict=True) if not fault])
    # LeRobot, which takes longest, comes before RLDS; the other workers continue with the episodes.
    work: list[Callable[[], Results]] = []
    for dataset in reversed(job.datasets):
        work.append(partial(_check_dataset, dataset, episodes, job.cache))
    if not job.of_failures and any(dataset.name == "rlds" for dataset in job.datasets):
        statistics = read_json(job.run.path(STATISTICS))
        work += [
            partial(_openvla_oft, statistics, folder, job.run.config.render.size_px)
            for folder in rlds_layout.datasets(job.run.dataset("rlds").folder)
        ]
    work += [partial(job, rows) for rows in _slices(episodes, job.rerendered, job.datasets)]
    for results in workers(call, work, "validate"):
        total.add(results)
    return total


def _find_open_fault(dataset: Format[Any]) -> Fault | None:
    """Open a dataset, and return the fault if it cannot be opened."""
    try:
        dataset.open()
    except PipelineError as error:
        return _unreadable(dataset, error)
    return None


def _unreadable(dataset: Format[Any], error: PipelineError) -> Fault:
    return Fault(dataset.name, None, str(error), "a dataset that can be opened")


def _counts(run: Run) -> Iterator[Fault]:
    """Check that the manifest has every planned row, and that no quota is exceeded, or open while candidates are left.

    The counts in ``counts.json`` must follow from the rows.
    """
    planned, rows = [row.episode_id for row in run.plan], run.manifest
    if planned != [row["episode_id"] for row in rows]:
        yield Fault("manifest", None, f"{len(rows)} rows", f"the {len(planned)} rows of the plan, in its order")
    quotas = grouped(((row["axis"], row["suite"], row["task"]), row) for row in rows)
    for (axis, suite, task), members in quotas.items():
        wanted = sum(row["wanted"] for row in members)
        kept = sum(row["reason"] in outcome.SUCCESS_REASONS for row in members)
        left = any(row["reason"] in (selection.NOT_NEEDED, selection.NOT_REPLAYED) for row in members)
        if kept > wanted or (kept < wanted and left):
            yield Fault("manifest", None, f"{kept} episodes of {axis} for {suite}/{task}", f"{wanted}")
    if read_json(run.path(COUNTS)) != by_axis_and_suite(rows):
        yield Fault("manifest", None, "counts.json does not follow from the rows", "the counts of the rows")


def _unlike_plan(run: Run) -> Iterator[Fault]:
    """Compare the plan's columns of the manifest with the plan, and ``chosen`` with ``export.where``."""
    where = run.config.export.where
    for planned, row in _planned_rows(run):
        chosen = outcome.is_selected(planned, where)
        yield from _unlike_row(row, {**asdict(planned), "chosen": chosen})


def _unlike_stores(run: Run) -> Iterator[Fault]:
    """Compare the results in the manifest with the tables of trajectories and frames.

    The check ``results`` compares results of the kept rows with the stored files.
    """
    try:
        trajectories, frames = run.trajectories.rows(), frames_by_trajectory(run.frames.rows())
        verdicts = run.outcome.verdicts
    except PipelineError as error:
        yield Fault("frames", None, str(error), "the output of the run")
        return
    trajectory_of = {row.episode_id: row.trajectory_id for row in run.plan}
    for planned, row in _planned_rows(run):
        # The trajectory of a reserve that was not needed may be stored for another episode.
        needed = row["reason"] != selection.NOT_NEEDED
        replayed = trajectories.get(planned.trajectory_id, {}) if needed else {}
        twin = trajectories.get(trajectory_of[planned.twin_id], {})
        rendered = bool(replayed) and has_frames(planned, frames, run.config.render.content.views)
        path_m, twin_path_m = replayed.get("path_m"), twin.get("path_m")
        verdict = verdicts[planned.episode_id]
        expected = {
            "kept": verdict.kept,
            "reason": verdict.reason,
            "steps": replayed.get("steps"),
            "replay_mode": replayed.get("mode"),
            "resolved": replayed.get("resolved"),
            **{each.name: replayed.get(each.name) for each in fields(Quality)},
            "path_ratio": path_m / twin_path_m if path_m is not None and twin_path_m else None,
            "gl_device": frames[planned.trajectory_id].device if rendered else None,
        }
        yield from _unlike_row(row, expected)


def _planned_rows(run: Run) -> Iterator[tuple[plan.Row, ManifestRow]]:
    """Yield each row of the plan with its row of the manifest; ``_counts`` reports missing rows."""
    row_of = {row["episode_id"]: row for row in run.manifest}
    for planned in run.plan:
        if planned.episode_id in row_of:
            yield planned, row_of[planned.episode_id]


def _unlike_row(row: ManifestRow, expected: Mapping[str, Any]) -> Iterator[Fault]:
    for column, value in expected.items():
        if row[column] != value:
            yield Fault("manifest", row["episode_id"], f"{column} is {row[column]!r}", repr(value))


def _check_dataset(dataset: Format[Any], episodes: Mapping[str, ManifestRow], cache: Path) -> Results:
    """Check a dataset as a whole."""
    results, faults = Results(), []
    try:
        # A loop, because faults that precede an error count.
        for name_and_fault in dataset.check(episodes, cache):
            faults.append(name_and_fault)
    except PipelineError as error:
        results.note("readable", [_unreadable(dataset, error)], 0)
    for check, checked in (("format", 1), ("ids", len(episodes)), ("splits", len(episodes)), ("readable", 0)):
        results.note(check, [fault for name, fault in faults if name == check], checked)
    return results


def _openvla_oft(statistics: Mapping[str, Any], folder: Path, size_px: int) -> Results:
    try:
        wrong = oft.check(folder, statistics, size_px)["violations"]
    except PipelineError as error:
        wrong = [str(error)]  # The reader stops at the first damaged file.
    results, name = Results(), folder.parent.name
    faults = [Fault("rlds", None, f"{name}: {what}", "a dataset that OpenVLA-OFT can train on") for what in wrong]
    results.note("openvla_oft", faults)
    return results


def _slices(
    kept: Mapping[str, ManifestRow], rerendered: Collection[str], datasets: Sequence[Format[Any]]
) -> list[list[ManifestRow]]:
    """Group all episodes into slices, each of which is checked in one call.

    Episodes to render again are grouped by trajectory, in the order of tasks, because they share a scene. The other
    episodes follow in the order of the datasets.
    """
    rows = sorted(kept.values(), key=lambda row: (row["suite"], row["task"]))
    by_trajectory = grouped((row["trajectory_id"], row) for row in rows if row["episode_id"] in rerendered)
    others = [row for row in rows if row["episode_id"] not in rerendered]
    # LeRobot's files are the largest, so they decide first: the next episode is in a file that is open already.
    columns = list(chain.from_iterable(dataset.columns for dataset in reversed(datasets)))
    others.sort(key=lambda row: [(row[column.name] is None, row[column.name]) for column in columns])
    return [*by_trajectory.values(), *(others[start : start + SLICE] for start in range(0, len(others), SLICE))]


@dataclass(frozen=True)
class EpisodesJob:
    """The checks of some episodes, in all places that store them.

    Attributes:
        datasets: the datasets that can be opened.
        cache: folder for temporary files of the checks of whole datasets.
        rerendered: ids of the episodes to render again.
        of_failures: True if the episodes missed their goal.
    """

    run: Run
    datasets: Sequence[Format[Any]]
    cache: Path
    rerendered: frozenset[str]
    of_failures: bool = False

    @cached_property
    def fully_decoded(self) -> frozenset[str]:
        """Ids of the ``FULLY_DECODED`` episodes of which all frames are decoded."""
        return frozenset(sorted(self.rerendered)[:FULLY_DECODED])

    def __call__(self, rows: Sequence[ManifestRow]) -> Results:
        results, language = Results(), self.run.config.plan.axes.language
        rewrites = {}
        for row in rows:
            rewrites[row["episode_id"]] = list_episode_rewrites(
                language, row["suite"], row["task"], row["perturbations"]
            )
        load = self.run.episode_loader(failures=self.of_failures, rewrites=rewrites)
        for row in rows:
            self._check(row, load, results)
        return results

    def _check(self, row: ManifestRow, load: EpisodeLoader, results: Results) -> None:
        episode_id = row["episode_id"]
        copies = []
        results.note("readable", [])
        for dataset in self.datasets:
            try:
                copy = dataset.read(row)
            except PipelineError as error:
                unreadable = Fault(dataset.name, episode_id, str(error), "an episode that can be read")
                results.note("readable", [unreadable], 0)
                continue
            if copy is not None:
                copies.append(copy)
            else:
                missing = Fault(dataset.name, episode_id, "is not in the dataset", "every kept episode")
                results.note("ids", [missing], 0)
        try:
            episode = load(episode_id)
            trajectory = self.run.trajectories.load(row["trajectory_id"])
        except PipelineError as error:
            results.note("stored", [Fault("frames", episode_id, str(error), "the output of the run")])
            return
        results.note("stored", [])
        if self.of_failures:  # The manifest has figures of kept episodes only.
            quality = measure(trajectory, task_of(row["suite"], row["task"], row["perturbations"]))
            row = {**row, **asdict(quality), "success": row["kept"]}
        language = self.run.config.plan.axes.language
        case = Case(
            row=row,
            episode=episode,
            trajectory=trajectory,
            copies=copies,
            bank=language.bank if language else None,
            decodes_all_frames=episode_id in self.fully_decoded,
        )
        for name, check in CHECKS.items():
            results.note(name, check.find(case), int(check.applies(case)))
        if episode_id in self.rerendered:
            results.note("rendered", compare_frames(case, self.run.config.render, scene_of_process()))
            results.note("subtasks", compare_subtasks(case))
