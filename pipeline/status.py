"""The state of a run: wanted and kept episodes, stages that would run and the reasons, and the disk.

Nothing is changed.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from rich.table import Table

from pipeline import stages
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.generated import FOLDERS, edits, edits_in_words
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import cleaning, counts, dataset_basis, dataset_files, dropped, finished, machine, plan_stage
from pipeline.run.outcome import outdated
from pipeline.run.progress import Progress
from pipeline.run.run import Run
from pipeline.validation.needs import free_gb, in_words, needed_mb, needed_s, workers_of


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
    steps = dict(_steps(run, progress))
    if steps:
        yield "stages that would run:"
        yield from (f"  {step}: {why}" for step, why in steps.items())
    # Until all episodes are replayed and rendered, undecided candidates count as kept, so nothing is short.
    if not steps.keys() & {"all stages", "plan", "replay", "render"}:
        missing = counts.shortfalls(_targets(config, progress))
        yield from missing
        if not steps:
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
    yield from _time_left(run, needed, progress, steps) if steps else ()


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


def _steps(run: Run, progress: Progress) -> Iterator[tuple[str, str]]:
    if not progress.rows:
        yield "all stages", "no plan exists yet; `doctor` checks the demonstrations and estimates the time"
        return
    why_planned = stages.why_not("plan", run)
    if why_planned is not None:
        yield "plan", why_planned
    generated_again = outdated(progress.rows, run.trajectories, run.frames)
    needed = progress.pending()
    if needed:
        yield "replay", f"{len(needed)} trajectories are missing" + _of(generated_again, "trajectories")
    missing = [row for row in _shown(progress) if not progress.has_frames(row)]
    if missing:
        yield "render", f"the frames of {len(missing)} episodes are missing" + _of(generated_again, "files of frames")
    if needed or missing or why_planned is not None:
        yield "exports and later stages", "some of their episodes are missing" if needed or missing else "a new plan"
        return
    yield from _follow(run)


def _follow(run: Run) -> Iterator[tuple[str, str]]:
    """Yield the stages that would work although every wanted trajectory and frame is stored."""
    yield from _outdated(run, ("doctor", "leakage"))
    stale = list(_stale_datasets(run))
    yield from stale
    if stale:
        yield "manifest and later stages", "the datasets would change"
        return
    yield from _outdated(run, ("manifest", "validate", "recipe", "summary", "card", "report"))


def _outdated(run: Run, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    for name in names:
        changed = stages.why_not(name, run)
        if changed is None:
            continue
        edited = any(edits(run.path(folder)) for folder in FOLDERS if folder in stages.STAGES[name].outputs)
        yield name, "stops before it overwrites edits" if edited else changed


def _stale_datasets(run: Run) -> Iterator[tuple[str, str]]:
    for dataset in (*run.formats, *(run.failure_formats if run.outcome.failures else ())):
        episodes = dataset_basis.episodes_of(dataset, run)
        changed_file = dataset_files.changed_file(dataset)
        if changed_file is not None:
            why = finished.missing_or_changed(changed_file, run.folder)
        elif not dataset.record().matches(dataset_basis.compute_basis(dataset, episodes)):
            reasons = dataset_basis.outdated(dataset, episodes)
            why = f"the dataset has {next(iter(reasons), 'files of other episodes or with other options')}"
        else:
            continue
        yield f"export_{dataset.group}", f"{dataset.title}: {why}"


def _of(generated_again: Counter[str], kind: str) -> str:
    reasons = "; ".join(f"{number} {reason}" for reason, number in generated_again.items() if reason.startswith(kind))
    return f" (would be generated again: {reasons})" if reasons else ""


def _time_left(run: Run, needed: Sequence[plan.Row], progress: Progress, steps: Mapping[str, str]) -> Iterator[str]:
    """Estimate the time left, from the speed that ``doctor`` measured, the needed rows and the stages to run."""
    speed = machine.known_speed(run)
    if speed is None or not needed:
        return
    exports = any(step.startswith(("plan", "replay", "render", "export")) for step in steps)
    validates = exports or any(step.startswith(("manifest", "validate")) for step in steps)
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
