"""Work of the stage ``plan``, and the plan that a run would have, for ``status`` and ``doctor``."""

import sys
from collections.abc import Sequence

from pipeline.config import Config
from pipeline.identity import digest_library, made_with
from pipeline.planning import plan
from pipeline.record import Basis
from pipeline.run import inputs
from pipeline.run.finished import StageRecord
from pipeline.run.layout import PLAN
from pipeline.run.run import Run
from pipeline.stores.store import TABLE
from pipeline.testset import benchmark


def make(config: Config) -> list[plan.Row]:
    """Plan a run; nothing is written.

    Raises:
        PipelineError: when a chosen task has no demonstration, or an axis has nothing to sample from.
    """
    index = config.demos.index()
    for problem in index.problems:
        print(f"left out: {problem.error}", file=sys.stderr)
    for note in index.notes:
        print(note, file=sys.stderr)
    config.demos.reject_tasks_without(index.entries)
    rows = plan.make(index.entries, config.plan, config.replay, benchmark.load())
    config.export.reject_too_few(plan.count_demonstrations(rows))
    return rows


def is_up_to_date(run: Run) -> bool:
    """Return whether the run has the plan that the stage would write: same settings, files, library and packages."""
    return record(run).is_up_to_date()


def upcoming(run: Run) -> Sequence[plan.Row]:
    """Return the plan that a run would have: the stored plan if it is up to date, else a new plan, which is not stored.

    If a run has neither a plan nor finished work, the result is empty, as planning may take a minute.

    Raises:
        PipelineError: as of ``make``.
    """
    if is_up_to_date(run):
        return run.plan
    records = [dataset.record_file for dataset in run.datasets]
    written = (run.plan_file, run.trajectories.root / TABLE, run.frames.root / TABLE, *records)
    return make(run.config) if any(file.exists() for file in written) else []


def record(run: Run) -> StageRecord:
    """Return the record of the stage: settings, the user's files, library and packages that the plan depends on."""
    config = run.config
    settings = inputs.settings(config)
    sections = {name: settings[name] for name in ("demos", "plan", "replay")}
    requested = {"settings": sections, "files": inputs.listing(config)}
    basis = Basis.of(requested, {**made_with("physics"), "code": digest_library()[:16]})
    return StageRecord(run.folder, "plan", basis, [PLAN])
