"""What the stage ``plan`` does, and how ``status`` and ``doctor`` know the plan that a run would make."""

import sys
from collections.abc import Sequence
from pathlib import Path

from pipeline.config import Config
from pipeline.files import checksum
from pipeline.formats.registry import FORMATS
from pipeline.identity import made_with
from pipeline.planning import plan
from pipeline.run import inputs
from pipeline.run.finished import Memory
from pipeline.seeding import digest
from pipeline.stores.store import TABLE
from pipeline.testset import benchmark

FILE = "plan.parquet"
LIBRARY = Path(__file__).parents[1]


def make(config: Config) -> list[plan.Row]:
    """Plan a run; nothing is written.

    Raises:
        PipelineError: when a chosen task has no demonstration, or an axis nothing to plan from.
    """
    index = config.demos.index()
    for problem in index.problems:
        print(f"left out: {problem.error}", file=sys.stderr)
    for note in index.notes:
        print(note, file=sys.stderr)
    config.demos.refuse_tasks_without(index.entries)
    rows = plan.make(index.entries, config.plan, config.replay, benchmark.load())
    config.export.refuse_too_few(plan.demonstrations(rows))
    return rows


def write(rows: Sequence[plan.Row], config: Config) -> None:
    """Write the plan, and remember what it was made from."""
    plan.write(rows, config.data / FILE)
    _memory(config).keep()


def is_up_to_date(config: Config) -> bool:
    """Whether the run's folder has the plan that the stage would write: same settings, files, library and packages."""
    return _memory(config).holds()


def upcoming(config: Config) -> list[plan.Row]:
    """The plan that a run would have: the one in its folder if up to date, else another, made here and not written.

    It is empty where a run has neither a plan nor finished work: then it is not made, which may take a minute.

    Raises:
        PipelineError: as of ``make``.
    """
    if is_up_to_date(config):
        return plan.read(config.data / FILE)
    records = [f"{kind.name}.json" for kind in FORMATS]
    written = (FILE, f"trajectories/{TABLE}", f"frames/{TABLE}", *records)
    return make(config) if any((config.data / name).exists() for name in written) else []


def _memory(config: Config) -> Memory:
    sections = {
        name: section for name, section in inputs.settings(config).items() if name in ("demos", "plan", "replay")
    }
    library = {file.relative_to(LIBRARY).as_posix(): checksum(file) for file in sorted(LIBRARY.rglob("*.py"))}
    made_by = digest(sections, inputs.listing(config), library, made_with("physics"))
    return Memory(config.data, "plan", made_by, [FILE])
