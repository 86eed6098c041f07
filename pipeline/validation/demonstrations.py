"""Whether a folder of demonstrations can be used: every file is read, and some of each file are replayed."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from glob import glob
from pathlib import Path

from pipeline import origins
from pipeline.compute.pool import LOST, Expendable, Workers
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import DemoEntry, HDF5Source
from pipeline.libero.tasks import find_task, suites
from pipeline.planning.plan import twins
from pipeline.run.outcome import MISSED
from pipeline.run.replay_job import ReplayJob
from pipeline.types import Task

LAYOUT = "<suite>/<task>_demo.hdf5, with a suite of LIBERO's or of one's own, whose tasks are tasks/<suite>/<task>.bddl"


@dataclass
class Found:
    """What a check came to.

    Attributes:
        faults: each names its file, its demonstration where it is about one, and what to do.
        missed: demonstrations whose replay misses the goal, though another of their file does not.
    """

    files: int = 0
    demonstrations: int = 0
    replayed: int = 0
    faults: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)


def check(root: Path, replays: int, run: Workers) -> Found:
    """Read every HDF5 file below a folder, and replay some demonstrations of each in the mode ``auto``.

    A replay that misses its goal is a fault where all of its file do: of good demonstrations a few miss.

    Args:
        root: folder with ``<suite>/<task>_demo.hdf5``.
        run: spreads the work; one call for each file.

    Raises:
        PipelineError: when there is no file, or a clone is imported in place of a package.
    """
    origins.check()
    files = [root / name for name in sorted(glob("**/*.hdf5", root_dir=root, recursive=True))]
    if not files:
        raise PipelineError("there is no HDF5 file", where=root, expected=LAYOUT)
    found, jobs = Found(len(files)), []
    for file in files:
        try:
            jobs.append(_FileJob(root, _task_of(file, root), replays))
        except PipelineError as error:
            found.faults.append(str(error))
    work = Expendable(_FileJob.__call__, _FileJob.limit_s, _FileJob.lost)
    first_with: dict[str, DemoEntry] = {}
    for entries, of_file in run(work, jobs, "files"):
        found.demonstrations += len(entries)
        found.replayed += of_file.replayed
        found.faults += of_file.faults
        found.missed += of_file.missed
        for entry in entries:
            first = first_with.setdefault(entry.sha256, entry)
            if first.demo_id != entry.demo_id:
                found.faults.append(f"{entry.demo_id}: holds the same as {first.demo_id}\n  try: delete one of the two")
    return found


def _task_of(file: Path, root: Path) -> Task:
    suite, *name = file.relative_to(root).parts
    if suite not in suites() or len(name) != 1 or not name[0].endswith("_demo.hdf5"):
        raise PipelineError("is not where a run looks", where=file, expected=LAYOUT, remedy="move or rename it")
    try:
        return find_task(suite, name[0].removesuffix("_demo.hdf5"))
    except PipelineError as error:
        remedy = error.remedy or "move or rename it"
        raise PipelineError(error.what, where=error.where or file, expected=error.expected, remedy=remedy) from error


_Result = tuple[Sequence[DemoEntry], Found]


@dataclass(frozen=True)
class _FileJob:
    root: Path
    task: Task
    replays: int

    def __call__(self) -> _Result:
        index = HDF5Source(self.root).index([self.task])
        # Of the other files of the suite, their own check tells.
        faults = [str(problem.error) for problem in index.problems if f"{problem.name}/".startswith(f"{self.task}/")]
        # The first, the last and others evenly between them.
        count = min(self.replays, len(index.entries))
        chosen = [index.entries[round(k * (len(index.entries) - 1) / max(count - 1, 1))] for k in range(count)]
        demos, replay = DemosConfig(root=self.root), ReplayConfig()
        with tempfile.TemporaryDirectory() as folder:
            jobs = [ReplayJob(row, row.trajectory_id, demos, replay, Path(folder)) for row in twins(chosen, 0, replay)]
            reasons = {entry: job().reason for entry, job in zip(chosen, jobs, strict=True)}
        all_miss = all(reason in MISSED for reason in reasons.values())
        missed = [] if all_miss else [entry.demo_id for entry, reason in reasons.items() if reason in MISSED]
        for entry, reason in reasons.items():
            if reason != "kept" and entry.demo_id not in missed:
                where = f"{self.root / entry.source.split()[0]} data/{entry.key}"
                what = "misses its goal, as do all that were replayed of this file" if all_miss else "not replayed"
                expected = "a demonstration recorded with this LIBERO version, or with its model_file"
                faults.append(str(PipelineError(f"{what} ({reason})", where=where, expected=expected)))
        return index.entries, Found(replayed=count, faults=faults, missed=missed)

    def limit_s(self) -> float:
        """So long it may take before it counts as hanging; a replay takes about a minute at most."""
        return 1800.0 + 600.0 * self.replays

    def lost(self) -> _Result:
        file = f"{self.root / self.task.suite / self.task.name}_demo.hdf5"
        return (), Found(faults=[f"{file}: {LOST}, no worker reads it"])
