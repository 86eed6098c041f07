"""The stages of a run in order: from demonstrations to datasets, checks and reports.

Each stage is a function of a ``Run``. ``perform`` calls it, unless its inputs and outputs are unchanged since the last
call. The command ``run`` performs all stages in one process; each script in ``stages/`` performs one stage, for DVC.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from pipeline import gl
from pipeline.clients.files import RECIPE
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.export_config import FAILURES
from pipeline.files import read_json, write, write_json
from pipeline.formats import exact_statistics, registry
from pipeline.formats.episodes import by_suite
from pipeline.formats.rlds import Rlds
from pipeline.identity import require_remake_permission
from pipeline.planning import leakage, plan
from pipeline.run import counts, dataset_files, dropped, export, finished, inputs, machine, manifest, plan_stage
from pipeline.run.claim import claim_folder, locked
from pipeline.run.cleaning import say_stale
from pipeline.run.finished import FRAMES_TABLE, TRAJECTORIES_TABLE, StageRecord
from pipeline.run.foreign import reject_foreign_files
from pipeline.run.layout import (
    CARD,
    COUNTS,
    DATASETS,
    FINETUNE,
    INPUTS,
    LEAKAGE,
    MACHINE,
    MANIFEST,
    PLAN,
    PREVIEWS,
    REPLAY,
    REPORTS,
    SETTINGS,
    SHEETS,
    STATISTICS,
)
from pipeline.run.outcome import join_kinds, outdated
from pipeline.run.render_stage import render_and_replace
from pipeline.run.replay_stage import Replays
from pipeline.run.rewrites import list_episode_rewrites
from pipeline.run.run import Run
from pipeline.testset import benchmark

EVERY_TIME = "the stage runs every time"
"""Reason of a stage without outputs of its own."""


@dataclass(frozen=True)
class Stage:
    """A step of a run.

    Attributes:
        work: function that performs the stage. A stage without outputs and record runs every time.
        settings: sections of ``settings.json`` that its outputs depend on.
        inputs: files and folders of the run that it reads.
        outputs: files and folders of the run that it writes.
        changed_file: function that returns a stored file behind the outputs that was changed or deleted, such as a
            shard behind the record of its dataset; `None` if all of them are unchanged.
        record: function that returns the record of the last call, if it does not follow from settings, inputs and
            outputs.
        unchanged: function that is called in place of ``work`` if the outputs are up to date.
    """

    work: Callable[[Run], None]
    settings: Sequence[str] = ()
    inputs: Sequence[str] = ()
    outputs: Sequence[str] = ()
    changed_file: Callable[[Run], Path | None] | None = None
    record: Callable[[Run], StageRecord] | None = None
    unchanged: Callable[[Run], None] | None = None


def write_inputs(run: Run) -> None:
    """Write the full configuration, list the user's own files, and notice changed or deleted stored files."""
    write_json(run.path(INPUTS), inputs.listing(run.config))
    run.trajectories.notice_changes()
    run.frames.notice_changes()
    for dataset in (*run.datasets, *run.failure_datasets):
        export.notice_changes(dataset)
    export.unlist_lost_records(run)
    write_json(run.path(SETTINGS), inputs.settings(run.config))


def doctor(run: Run) -> None:
    """Check the machine and the installation against the needs of the run, and record the machine's trial."""
    from pipeline.validation import doctor as doctor_checks

    try:
        tried = finished.trial_record(run, gl.choose().device).is_up_to_date()
    except PipelineError:
        # The table of `doctor_checks.run` reports missing packages.
        tried = False
    failed = doctor_checks.run(run, tried=tried)
    if failed:
        raise PipelineError(
            f"the run cannot begin, because of failed checks: {', '.join(failed)}",
            where=run.folder,
            remedy="follow the remedies of the failed checks above, and run the command again",
        )
    if tried and machine.known_speed(run) is not None:
        return
    trial = machine.trial()
    if not tried:
        machine.record(run, trial.digests)
        finished.trial_record(run, gl.choose().device).write()
    machine.keep_speed(run, trial.speed)


def make_plan(run: Run) -> None:
    """Sample every perturbation of the run and write the plan, one row for each wanted episode and each reserve."""
    rows = plan_stage.make(run.config)
    dropped.reject_deletion(rows, run)
    for axis, number in plan.shortage(rows, run.config.plan).items():
        print(
            f"{axis}: {number} of {run.config.plan.episodes[axis]} wanted episodes cannot be planned, because no "
            "different perturbation is left; use more demonstrations or request fewer episodes",
            file=sys.stderr,
        )
    plan.write(rows, run.plan_file)
    wanted = [row for row in rows if row.wanted]
    trajectories = {row.trajectory_id for row in wanted}
    reserves = {row.trajectory_id for row in rows} - trajectories
    print(f"planned {len(wanted)} episodes from {len(trajectories)} trajectories, and {len(reserves)} in reserve")
    print(f"the episodes have at most {len(trajectories)} distinct action sequences, one for each trajectory")


def check_leakage(run: Run) -> None:
    """Compare every planned perturbation with the benchmark's test tasks, and stop if one overlaps.

    On an axis that is configured to keep no clearance, overlaps are only reported.
    """
    findings = leakage.check(run.plan, benchmark.load())
    leakage.write(findings, run.path(LEAKAGE))
    Console().print(leakage.report(findings))
    for name, axis in run.config.plan.axes.configured().items():
        if not axis.keeps_clearance:
            findings.pop(name, None)
    leakage.reject_overlap(findings)


def replay(run: Run) -> None:
    """Replay and judge every planned trajectory, without OpenGL; a stopped stage resumes."""
    rows, config = run.plan, run.config
    plan.reject_other_settings(rows, config.replay)
    require_remake_permission(join_kinds(outdated(rows, run.trajectories, run.frames)), run.folder)
    dropped.reject_deletion(rows, run)
    with run.workers() as workers:
        replays = Replays(config.demos, config.replay, run.trajectories, workers, config.filter)
        verdicts = replays.complete(rows)
    # Keep the reserves too that the stage `render` replayed because frames were rejected.
    run.trajectories.keep(row.trajectory_id for row in rows)
    kept = sum(verdict.kept for verdict in verdicts.values())
    write_json(run.path(REPLAY), {"replayed": len(verdicts), "kept": kept})
    print(f"replayed {len(verdicts)} trajectories, {kept} are kept")


def render(run: Run) -> None:
    """Render the frames of every kept episode from the stored states; a stopped stage resumes.

    If frames are rejected, the reserves that replace their episodes are replayed, as in the stage ``replay``.
    """
    print(gl.choose())
    rows, config = run.plan, run.config
    plan.reject_other_settings(rows, config.replay)
    outdated_files = outdated(rows, run.trajectories, run.frames, gl.choose().device)
    require_remake_permission(join_kinds(outdated_files), run.folder)
    dropped.reject_deletion(rows, run)
    # The configuration may have changed since the plan was written.
    config.export.reject_too_few(plan.count_demonstrations(rows))
    replayed = int(read_json(run.path(REPLAY))["replayed"])
    with run.workers(renders=True) as workers:
        replays = Replays(config.demos, config.replay, run.trajectories, workers, config.filter)
        verdicts, rendered = render_and_replace(rows, config, replays, run.frames)
    run.trajectories.keep(verdicts)
    further = len(verdicts) - replayed
    if further:
        print(f"replayed {further} reserves, which replace episodes with rejected frames")
    print(f"{len(rendered)} files of frames are stored in {run.frames.root}")


def _export(group: str) -> Stage:
    """Return the stage that writes the kept episodes in the formats of a group."""
    kinds = registry.formats_in(group)
    records = [f"{kind.name}.json" for kind in kinds]

    def write_datasets(run: Run) -> None:
        for kind in kinds:
            # The group's first format is named even if it is not requested, so that no stage is silent.
            if kind is kinds[0] or kind.name in run.config.export.formats:
                export.export_run(kind, run)
        export.list_records(run)
        say_stale(group, run)

    def changed_file(run: Run) -> Path | None:
        """Return a changed or missing file of the finished datasets, or their list of records if it is missing."""
        if not run.path(DATASETS).exists():
            return run.path(DATASETS)
        datasets = [dataset for dataset in run.recorded_datasets if dataset.group == group]
        return dataset_files.first_changed_file(datasets)

    write_datasets.__doc__ = f"Write the kept episodes as {' and '.join(kind.title for kind in kinds)}."
    records_of_failures = [f"{FAILURES}/{record}" for record in records]
    return Stage(
        work=write_datasets,
        settings=_LABELLED,
        inputs=(INPUTS, *_OUTCOME),
        outputs=(*records, *records_of_failures),
        changed_file=changed_file,
    )


def write_manifest(run: Run) -> None:
    """Write one row for every planned episode, the statistics for OpenVLA-OFT, and the counts."""
    config, outcome = run.config, run.outcome
    table = manifest.build(
        outcome,
        registry.places(run.datasets),
        registry.columns(),
        config.export.where,
        lambda row: list_episode_rewrites(config.plan.axes.language, row.suite, row.task, row.perturbations),
    )
    manifest.write(table, run.manifest_file, manifest.Settings.of(config))
    write_json(run.path(STATISTICS), _openvla_statistics(run))
    write_json(run.path(COUNTS), counts.by_axis_and_suite(table.to_pylist()))


def _openvla_statistics(run: Run) -> dict[str, Any]:
    """Map the name of each suite's dataset to the statistics of its kept episodes for OpenVLA-OFT."""
    kept = {episode_id: run.outcome.row_of[episode_id] for episode_id in run.outcome.kept}
    # Episodes of a trajectory have the same motion, which is read once.
    motions = {name: run.frames.motion(name) for name in {row.trajectory_id for row in kept.values()}}
    suites = {episode_id: row.suite for episode_id, row in kept.items()}
    dataset_name = (run.config.export.options_for(Rlds) or run.config.export).name
    statistics = {}
    for name, episode_ids in by_suite(suites, dataset_name).items():
        motions_of_suite = [motions[kept[episode_id].trajectory_id] for episode_id in episode_ids]
        statistics[name] = exact_statistics.openvla(motions_of_suite)
    return statistics


def validate(run: Run) -> None:
    """Reopen the datasets and the manifest, and stop if they differ from the generated episodes."""
    from pipeline.validation.validate import validate as validate_run

    with run.workers(renders=True) as workers:
        report = validate_run(run, workers)
    file = run.validation_file
    write_json(file, report)
    errors = {check: result["findings"] for check, result in report.items() if result["findings"]}
    if errors:
        first = next(iter(errors.values()))[0]
        numbers = ", ".join(f"{check} {len(findings)}" for check, findings in errors.items())
        raise PipelineError(
            f"{first['what']}; number of findings of each check: {numbers}",
            where=f"{first['dataset']} {first['episode'] or ''}".strip(),
            expected=first["expected"],
            remedy=f"read {file}, correct the cause, and run `{MAKE_AGAIN}` again",
        )
    print(f"{len(report)} checks found no errors, see {file}")


def date_validation(run: Run) -> None:
    """Give the report of unchanged files the present date: `push` requires checks no older than the checked files."""
    run.validation_file.touch()


def write_recipe(run: Run) -> None:
    """Write the fine-tuning recipe, and the files that each policy's code needs to train on the datasets."""
    from pipeline.clients import recipe

    config = run.config
    probability = config.finetune.rewrite_probability
    built = recipe.build(run.manifest_file, run.manifest, config.export, probability, config.render.content)
    folders = {dataset.name: dataset.folder for dataset in run.datasets}
    recipe.write(built, run.path(FINETUNE), config.export, folders)
    file = run.path(FINETUNE) / RECIPE
    print(f"wrote {file}, with the recipe and a command line for each of {', '.join(built['clients'])}")


def summarize(run: Run) -> None:
    """Render contact sheets, of the run and of one task per suite, and print the run's counts."""
    from pipeline.report import preview, sheets

    sheets.write(run.manifest, run.episode_loader(), run.path(SHEETS))
    previews = finished.previews_record(run)
    if not previews.is_up_to_date():
        with run.workers(renders=True) as workers:
            preview.for_run(run.config, run.path(PREVIEWS), workers)
        previews.write()
    print_counts(run)


def print_counts(run: Run) -> None:
    """Print the run's counts, and its missed targets."""
    rows, episodes = run.manifest, run.config.plan.episodes
    Console().print(counts.shown(rows, episodes))
    print(counts.Diversity.of(rows))
    missing = counts.shortfalls(counts.targets(rows, episodes))
    for sentence in (*missing, *counts.lost_to_workers(rows), *counts.beyond_step_limit(rows)):
        print(sentence)


def write_card(run: Run) -> None:
    """Write the dataset card of each format, from the manifest and the reports."""
    from pipeline.publish import card

    card.write(run)
    print(f"wrote {run.path(CARD)}, with a README.md for each format; `dataset push` uploads it with the data")


def write_report(run: Run) -> None:
    """Write one HTML page about the run, which contains its counts, plots, pictures and videos."""
    from pipeline.report import report

    write(run.report_file, report.page(run, benchmark.load()))
    name_report(run)


def name_report(run: Run) -> None:
    """Print where the report is."""
    file = run.report_file
    print(f"report: {file} ({file.stat().st_size / 1e6:.1f} MB), which opens in any browser")


def _changed_replay(run: Run) -> Path | None:
    return run.trajectories.changed_file()


def _changed_frames(run: Run) -> Path | None:
    return run.trajectories.changed_file() or run.frames.changed_file()


_OUTCOME = (PLAN, TRAJECTORIES_TABLE, FRAMES_TABLE)
_RECORDS = tuple(f"{kind.name}.json" for kind in registry.FORMATS)
_LABELLED = ("filter", "export", "plan")
"""Settings of stages that list rewrites: they depend on the plan's language axis and, by ``INPUTS``, on the bank."""

STAGES = {
    "inputs": Stage(work=write_inputs),
    "doctor": Stage(work=doctor, settings=(*inputs.SECTIONS, "host"), inputs=(INPUTS,), outputs=(MACHINE,)),
    "plan": Stage(work=make_plan, record=plan_stage.record),
    "leakage": Stage(work=check_leakage, inputs=(PLAN,), outputs=(LEAKAGE,)),
    "replay": Stage(
        work=replay,
        settings=("demos", "replay", "filter"),
        inputs=(INPUTS, MACHINE, PLAN, LEAKAGE),
        outputs=(REPLAY, TRAJECTORIES_TABLE),
        changed_file=_changed_replay,
    ),
    "render": Stage(
        work=render,
        settings=("demos", "replay", "filter", "render", "export"),
        inputs=(INPUTS, MACHINE, PLAN, REPLAY),
        outputs=(TRAJECTORIES_TABLE, FRAMES_TABLE),
        changed_file=_changed_frames,
    ),
    **{f"export_{group}": _export(group) for group in registry.GROUPS},
    "manifest": Stage(
        work=write_manifest,
        settings=_LABELLED,
        inputs=(INPUTS, *_OUTCOME, *_RECORDS),
        outputs=(MANIFEST, STATISTICS, COUNTS),
    ),
    "validate": Stage(work=validate, record=finished.validate_record, unchanged=date_validation),
    "recipe": Stage(
        work=write_recipe, settings=("export", "finetune"), inputs=(MANIFEST, *_RECORDS), outputs=(FINETUNE,)
    ),
    "summary": Stage(work=summarize, record=finished.summary_record, unchanged=print_counts),
    "card": Stage(
        work=write_card,
        settings=inputs.PUBLISHED,
        inputs=(MANIFEST, *REPORTS, *_RECORDS, FINETUNE, SHEETS),
        outputs=(CARD,),
    ),
    "report": Stage(work=write_report, record=finished.report_record, unchanged=name_report),
}
"""Name to stage, in the order in which they run; ``stages/exports.py`` performs all stages ``export_<group>``."""


def run_all(file: Path) -> Run:
    """Perform every stage of a configuration in this process, under a lock in the run's folder.

    Returns:
        The finished run.

    Raises:
        PipelineError: when a stage stops, or another process works in the folder.
    """
    config = claim_folder(file)
    with locked(config.run_folder):
        for number, name in enumerate(STAGES, start=1):
            perform(name, Run(config), f"[{number}/{len(STAGES)}] {name}")
    return Run(config)


def perform(name: str, run: Run, title: str = "") -> None:
    """Perform a stage, unless its inputs and outputs are unchanged since the last call.

    Args:
        title: printed first; the name by default.

    Raises:
        PipelineError: when the stage stops.
    """
    # A file that changes while the stage works must count as changed at the next call.
    stage, record = STAGES[name], _record(name, run)
    reason = _reason(stage, record, run)
    if reason is None:
        print(f"{title or name}: up to date", flush=True)
        if stage.unchanged is not None:
            stage.unchanged(run)
        return
    print(title or name, flush=True)
    if reason not in (EVERY_TIME, finished.NO_RECORD):
        print(f"  reason: {reason}", flush=True)
    reject_foreign_files(run.folder)
    stage.work(run)
    if record is not None:
        record.write()


def reason_to_run(name: str, run: Run) -> str | None:
    """Describe why a stage has to work; `None` if its outputs are up to date."""
    return _reason(STAGES[name], _record(name, run), run)


def _reason(stage: Stage, record: StageRecord | None, run: Run) -> str | None:
    """Describe why a stage with this record has to work; `None` if its outputs are up to date."""
    reason = EVERY_TIME if record is None else record.reason_to_run()
    if reason is not None or stage.changed_file is None:
        return reason
    file = stage.changed_file(run)
    return None if file is None else finished.missing_or_changed(file, run.folder)


def _record(name: str, run: Run) -> StageRecord | None:
    """Return the record of the stage's last call, `None` for a stage that runs every time."""
    stage = STAGES[name]
    if stage.record is not None:
        return stage.record(run)
    if not stage.outputs:
        return None
    settings = inputs.settings(run.config)
    chosen = {section: settings[section] for section in stage.settings}
    return finished.stage_record(run, name, chosen, stage.inputs, stage.outputs)
