"""The state of a run: wanted and kept episodes, stages that would run and the reasons, and the disk.

Nothing is changed.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence

from rich.table import Table

from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.formats.registry import GROUPS
from pipeline.generated import FOLDERS, edits, edits_in_words
from pipeline.identity import describe_outdated
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import cleaning, counts, dataset_basis, dataset_files, dropped, finished, machine, plan_stage
from pipeline.run.outcome import RENDERINGS, REPLAYS, join_kinds, outdated
from pipeline.run.progress import Progress
from pipeline.run.run import Run
from pipeline.stages import STAGES, reason_to_run
from pipeline.validation.needs import free_gb, in_words, needed_mb, needed_s, workers_of

EXPORTS = frozenset(f"export_{group}" for group in GROUPS)
"""Stages that write the datasets."""

EXPORTS_AND_LATER = tuple(STAGES)[list(STAGES).index("render") + 1 :]
"""Stages after ``render``, in order."""

NO_PLAN = "no plan exists yet; `doctor` checks the demonstrations and estimates the time"
EPISODES_MISSING = "some of their episodes are missing"
NEW_PLAN = "a new plan"
DATASETS_CHANGE = "the datasets would change"
"""Reasons that a stage has in common with all stages after it; a line states each for all of them."""


def describe(run: Run) -> Iterator[str | Table]:
    """Yield a run's state as a few paragraphs and tables."""
    config = run.config
    yield f"run {run.name}, in {run.folder}"
    if config.demos.root is not None and not config.demos.root.is_dir():
        yield f"the run cannot be planned: demos.root: there is no folder {config.demos.root}"
        return
    try:
        rows = plan_stage.upcoming(run)
    except PipelineError as error:
        yield f"the run cannot be planned: {error}"
        return
    progress = Progress.of(rows, run.trajectories.rows(), run.frames.rows(), config)
    if rows or config.plan.episodes:
        yield _counts(config, progress)
    reasons = _reasons_to_run(run, progress)
    if reasons:
        yield "stages that would run:"
        yield from (f"  {line}" for line in _in_lines(reasons))
    # Until all episodes are replayed and rendered, undecided candidates count as kept, so nothing is short.
    if not reasons.keys() & {"plan", "replay", "render"}:
        missing = counts.shortfalls(_targets(config, progress))
        yield from missing
        if not reasons:
            yield "no stage would run" if missing else "no stage would run: all datasets are finished"
    unneeded = dropped.measure(rows, run)
    if unneeded.asks:
        yield (
            f"finished work that is no longer needed: {unneeded}. A run stops before it deletes this work, unless "
            "REMAKE=1 allows it"
        )
    yield from edits_in_words(run.folder)
    yield _disk(run)
    # Count undecided candidates as kept until they are replayed.
    needed = [*_shown(progress), *progress.undecided()]
    yield from _time_left(run, needed, progress, reasons.keys()) if reasons else ()


def _shown(progress: Progress) -> list[plan.Row]:
    """List the episodes that have frames, or get frames in the stage ``render``."""
    return [row for row in progress.to_render() if not progress.is_rejected(row)]


def _targets(config: Config, progress: Progress) -> dict[str, counts.Target]:
    """Count the episodes of the whole plan. Replays do not depend on ``export.where``."""
    results = []
    for row in progress.rows:
        reason = progress.verdict(row).reason
        results.append({"axis": row.axis, "wanted": row.wanted, "reason": reason, "chosen": True})
    return counts.targets(results, config.plan.episodes)


def _counts(config: Config, progress: Progress) -> Table:
    rows = progress.rows
    table = Table("axis", title="episodes" if rows else "episodes, without the clean twins, which the plan adds")
    for head in ("wanted", "planned", "reach their goal", "rendered"):
        table.add_column(head, justify="right", no_wrap=True)
    numbers = []
    axes = ["clean", *config.plan.episodes] if rows else config.plan.episodes
    for axis in axes:
        of_axis = [row for row in rows if row.axis == axis]
        kept = [row for row in of_axis if progress.verdict(row).kept]
        planned = sum(row.wanted for row in of_axis)
        wanted = config.plan.episodes.get(axis, planned)
        rendered = sum(progress.has_frames(row) for row in kept)
        numbers.append((wanted, planned, len(kept), rendered))
        # The name of a combination may break after a +.
        table.add_row(axis.replace("+", "+ "), *map(str, numbers[-1]))
    table.add_section()
    table.add_row("all", *map(str, map(sum, zip(*numbers, strict=True))))
    return table


def _reasons_to_run(run: Run, progress: Progress) -> dict[str, str]:
    """Map the stages that would run, in their order, to the reasons."""
    if not progress.rows:
        return dict.fromkeys(STAGES, NO_PLAN)
    reasons: dict[str, str] = {}
    why_planned = reason_to_run("plan", run)
    if why_planned is not None:
        reasons["plan"] = why_planned
    generated_again = outdated(progress.rows, run.trajectories, run.frames)
    not_replayed = progress.pending()
    if not_replayed:
        again = _generated_again(generated_again, REPLAYS)
        reasons["replay"] = f"{len(not_replayed)} trajectories are missing{again}"
    not_rendered = [row for row in _shown(progress) if not progress.has_frames(row)]
    if not_rendered:
        again = _generated_again(generated_again, RENDERINGS)
        reasons["render"] = f"the frames of {len(not_rendered)} episodes are missing{again}"
    if not_replayed or not_rendered:
        return reasons | dict.fromkeys(EXPORTS_AND_LATER, EPISODES_MISSING)
    if why_planned is not None:
        return reasons | dict.fromkeys(EXPORTS_AND_LATER, NEW_PLAN)
    return _other_reasons_to_run(run)


def _other_reasons_to_run(run: Run) -> dict[str, str]:
    """Map the stages that would run although the plan is up to date, and its trajectories and frames are stored."""
    reasons: dict[str, str] = {}
    stale = _stale_datasets(run)
    for name in STAGES:
        if name in ("inputs", "plan", "replay", "render"):
            continue
        if name in EXPORTS:
            reason = stale.get(name)
        elif stale and name in EXPORTS_AND_LATER:
            reason = DATASETS_CHANGE
        else:
            reason = _reason_to_run(name, run)
        if reason is not None:
            reasons[name] = reason
    return reasons


def _reason_to_run(name: str, run: Run) -> str | None:
    """Return the reason why a stage would run, or would stop because of edits; `None` if its outputs are up to date."""
    reason = reason_to_run(name, run)
    if reason is None:
        return None
    edited = any(edits(run.path(folder)) for folder in FOLDERS if folder in STAGES[name].outputs)
    return "stops before it overwrites edits" if edited else reason


def _stale_datasets(run: Run) -> dict[str, str]:
    """Map the stages ``export_<group>`` that would write a dataset again to the reasons."""
    reasons: dict[str, list[str]] = {}
    for dataset in (*run.datasets, *(run.failure_datasets if run.outcome.failures else ())):
        episodes = dataset_basis.episodes_of(dataset, run)
        changed_file = dataset_files.changed_file(dataset)
        if changed_file is not None:
            reason = finished.missing_or_changed(changed_file, run.folder)
        elif not dataset.record().matches(dataset_basis.compute_basis(dataset, episodes)):
            differences = dataset_basis.outdated(dataset, episodes)
            reason = f"the dataset has {next(iter(differences), 'files of other episodes or with other options')}"
        else:
            continue
        folder = dataset.folder.relative_to(run.folder)
        reasons.setdefault(f"export_{dataset.group}", []).append(f"{folder}: {reason}")
    return {name: "; ".join(of_stage) for name, of_stage in reasons.items()}


def _generated_again(outdated_files: Mapping[str, Counter[str]], kind: str) -> str:
    """Describe the outdated files of a kind in brackets; empty without such files."""
    files = join_kinds({kind: outdated_files.get(kind, Counter())})
    return f" (would be generated again: {describe_outdated(files)})" if files else ""


def _in_lines(reasons: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each stage; the stages that run because of earlier stages share the last line."""
    for name, reason in reasons.items():
        if reason not in (NO_PLAN, EPISODES_MISSING, NEW_PLAN, DATASETS_CHANGE):
            yield f"{name}: {reason}"
        elif reason == NO_PLAN:
            yield f"all stages: {reason}"
            return
        else:
            yield f"{'exports' if name in EXPORTS else name} and later stages: {reason}"
            return


def _time_left(run: Run, needed: Sequence[plan.Row], progress: Progress, to_run: Collection[str]) -> Iterator[str]:
    """Estimate the time left, from the speed that ``doctor`` measured, the needed rows and the stages to run."""
    speed = machine.known_speed(run)
    if speed is None or not needed:
        return
    exports = not EXPORTS.isdisjoint(to_run)
    validates = exports or not {"manifest", "validate"}.isdisjoint(to_run)
    left = not_made(progress, needed) | {"export": float(exports), "validate": float(validates)}
    left["GPU"] = left["render"]
    left_s = {stage: s * left.get(stage, 1.0) for stage, s in needed_s(run.config, speed).items()}
    yield f"time left: {in_words(left_s, workers_of(run.config.compute))}"


def not_made(progress: Progress, needed: Sequence[plan.Row]) -> dict[str, float]:
    """Return the shares in [0, 1] of the trajectories and streams that ``replay`` and ``render`` have yet to generate.

    Trajectories and streams that several needed rows share count once.
    """
    trajectories = {row.trajectory_id for row in needed}
    streams: set[tuple[str, str]] = set()
    for row in needed:
        streams_of_row = streams_of(row.perturbations, progress.views).values()
        streams |= {(row.trajectory_id, stream.stream_id) for stream in streams_of_row}
    rendered: set[tuple[str, str]] = set()
    for trajectory_id, stored in progress.frames.items():
        rendered |= {(trajectory_id, stream_id) for stream_id in stored.streams}
    return {
        "replay": len(trajectories - progress.replay_verdicts.keys()) / len(trajectories),
        "render": len(streams - rendered) / len(streams),
    }


def _disk(run: Run) -> str:
    used = cleaning.found(run, cleaning.PARTS)
    listed = ", ".join(f"{part} {size_mb / 1e3:.2f}" for part, size_mb in used.items() if size_mb >= 10)
    return (
        f"disk: {sum(used.values()) / 1e3:.2f} GB used{f' ({listed})' if listed else ''}, about "
        f"{sum(needed_mb(run.config).values()) / 1e3:.1f} GB when finished, {free_gb(run.folder):.1f} GB free"
    )
