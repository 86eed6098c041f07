"""Checks of a folder of demonstrations: every file is read, and some demonstrations of each file are replayed."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from glob import glob
from pathlib import Path

from pipeline import origins
from pipeline.axes.language_lint import too_long
from pipeline.compute.pool import LOST, Job, Workers, run_job
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.formats.hdf5.layout import VALIDATION_FOLDER
from pipeline.libero.carried import task_named
from pipeline.libero.demonstrations import DemoEntry, HDF5Source
from pipeline.libero.hdf5 import SUFFIX, demo_file
from pipeline.libero.starts import kept_actions, recorded_start
from pipeline.libero.tasks import IN_SCENE, STEP_LIMITS, exceeds_step_limit, find_task, suites
from pipeline.physics.environment import environment_of
from pipeline.planning.plan import twins
from pipeline.run.replay_job import ReplayJob
from pipeline.run.verdicts import FAILURE_REASONS
from pipeline.testset.own_tasks import reject_test_tasks
from pipeline.types import Task

LAYOUT = "<suite>/<task>_demo.hdf5, of a suite of LIBERO, or of an own suite with tasks/<suite>/<task>.bddl"


@dataclass
class CheckedDemos:
    """The result of a check.

    Attributes:
        faults: errors; each names its file, its demonstration if it is about a single one, and a remedy.
        missed: demonstrations whose replay misses the goal, while another one of the file reaches it.
        notes: contents of files that a run uses in a way which their author may not expect.
    """

    files: int = 0
    demonstrations: int = 0
    replayed: int = 0
    faults: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check(root: Path, replays: int, run: Workers, replay: ReplayConfig = ReplayConfig()) -> CheckedDemos:  # noqa: B008 - frozen
    """Read every HDF5 file below a folder, and replay some demonstrations of each.

    A replay that misses its goal is a fault only if all replays of its file miss: a few good demonstrations miss, too.

    Args:
        root: folder with ``<suite>/<task>_demo.hdf5``.
        run: workers, which get one call for each file.
        replay: settings of the run that will use the demonstrations.

    Raises:
        PipelineError: when there is no file, or a clone is imported in place of a package.
    """
    origins.check()
    files = [root / name for name in sorted(glob("**/*.hdf5", root_dir=root, recursive=True))]
    if not files:
        raise PipelineError("there is no HDF5 file", where=root, expected=LAYOUT)
    result, jobs = CheckedDemos(len(files)), []
    for file in files:
        unread = _unread(file, root)
        if unread:
            result.notes.append(f"{file}: {unread}")
            continue
        try:
            task = _task_of(file, root)
            reject_test_tasks([task])
            jobs.append(_FileJob(root, task, replays, replay))
        except PipelineError as error:
            result.faults.append(str(error))
    first_with: dict[str, DemoEntry] = {}
    for entries, of_file in run(run_job, jobs, "files"):
        result.demonstrations += len(entries)
        result.replayed += of_file.replayed
        result.faults += of_file.faults
        result.missed += of_file.missed
        result.notes += of_file.notes
        for entry in entries:
            first = first_with.setdefault(entry.sha256, entry)
            if first.demo_id != entry.demo_id:
                remedy = "leave the task of one of the two out of demos.tasks"
                result.faults.append(f"{entry.demo_id}: has the content of {first.demo_id}\n  try: {remedy}")
    return result


def _unread(file: Path, root: Path) -> str | None:
    """Return the reason why no run reads a file that an export in this layout wrote; `None` for other files."""
    folder, *below = file.relative_to(root).parts
    if folder == VALIDATION_FOLDER and len(below) == 2:
        return f"no run with this demos.root reads it; check the validation part as a folder, {root / folder}"
    name = file.name.removesuffix(SUFFIX)
    if IN_SCENE in name and folder in suites() and len(below) == 1:
        with suppress(PipelineError):
            task_named(folder, name)
            return "no run reads it, because it has episodes of a task in the scene of another"
    return None


def _task_of(file: Path, root: Path) -> Task:
    suite, *name = file.relative_to(root).parts
    if suite not in suites() or len(name) != 1 or not name[0].endswith(SUFFIX):
        raise PipelineError("no run reads this file", where=file, expected=LAYOUT, remedy="move or rename the file")
    try:
        return find_task(suite, name[0].removesuffix(SUFFIX))
    except PipelineError as error:
        remedy = error.remedy or "move or rename the file"
        raise PipelineError(error.what, where=error.where or file, expected=error.expected, remedy=remedy) from error


_Result = tuple[Sequence[DemoEntry], CheckedDemos]


@dataclass(frozen=True)
class _FileJob(Job[_Result]):
    root: Path
    task: Task
    replays: int
    replay: ReplayConfig

    def __call__(self) -> _Result:
        index = HDF5Source(self.root).index([self.task])
        # The other files of the suite are reported by their own checks.
        faults = [str(problem.error) for problem in index.problems if f"{problem.name}/".startswith(f"{self.task}/")]
        if not index.entries and not faults:
            expected = "groups data/demo_<number>"
            faults.append(
                str(PipelineError("the file has no usable demonstration", where=self._file, expected=expected))
            )
        chosen = self._chosen(index.entries)
        reasons = self._replayed(chosen, self.replay)
        missing = [entry for entry, reason in reasons.items() if reason in FAILURE_REASONS]
        all_miss = len(missing) == len(chosen) > 0
        faults += [self._not_replayed(entry, reasons[entry]) for entry in chosen if _is_rejected(reasons[entry])]
        if all_miss:
            faults += self._missing(missing, reasons)
        reached = [entry for entry, reason in reasons.items() if reason == "kept"]
        faults += filter(None, map(self._reached_at_start, reached))
        missed = [] if all_miss else [entry.demo_id for entry in missing]
        notes = [*index.notes, *_instruction_notes(self.task), *self._length_notes(index.entries)]
        return index.entries, CheckedDemos(replayed=len(chosen), faults=faults, missed=missed, notes=notes)

    def _chosen(self, entries: Sequence[DemoEntry]) -> list[DemoEntry]:
        """Choose the first and the last demonstration, and further ones evenly between them."""
        count = min(self.replays, len(entries))
        return [entries[round(k * (len(entries) - 1) / max(count - 1, 1))] for k in range(count)]

    def _replayed(self, entries: Sequence[DemoEntry], replay: ReplayConfig) -> dict[DemoEntry, str]:
        """Replay demonstrations under the given settings; return the reason of each verdict."""
        demos = DemosConfig(root=self.root)
        with tempfile.TemporaryDirectory() as folder:
            rows = twins(entries, 0, replay)
            jobs = [ReplayJob(row, row.trajectory_id, demos, replay, Path(folder)) for row in rows]
            return {entry: job().reason for entry, job in zip(entries, jobs, strict=True)}

    def _not_replayed(self, entry: DemoEntry, reason: str) -> str:
        expected = "a demonstration recorded with this LIBERO version, or with its model_file"
        return str(
            PipelineError(
                f"the demonstration cannot be replayed ({reason})", where=self._place(entry), expected=expected
            )
        )

    def _reached_at_start(self, entry: DemoEntry) -> str | None:
        """Return an error if the goal holds before the first action, which makes every replay a success."""
        environment, demo = environment_of(self.task), HDF5Source(self.root).load(entry.demo_id)
        assert demo.model_xml is not None, "HDF5 files have it"
        environment.restore(recorded_start(demo, demo.model_xml, settles=self.replay.settle_steps > 0))
        environment.settle(self.replay.settle_steps)
        if not environment.succeeded():
            return None
        what = "the goal holds before the first action, so every replay counts as a success"
        expected = "a goal that the demonstration's actions reach"
        return str(PipelineError(what, where=self._place(entry), expected=expected))

    def _missing(self, entries: Sequence[DemoEntry], reasons: Mapping[DemoEntry, str]) -> Iterator[str]:
        """Report each demonstration of a file whose replays all miss, with dropped no-ops and settings that help."""
        working = []
        for changed in _changed_replays(self.replay):
            kept = sum(reason == "kept" for reason in self._replayed(entries, changed).values())
            if kept:
                working.append(f"{_in_words(changed)} ({kept} of {len(entries)} reach the goal)")
        if working:
            expected = "settings of the run under which the demonstrations reach their goal"
            remedy = f"set {'; or '.join(working)}"
        else:
            expected = "a demonstration that reaches the goal of its task's BDDL file from its first state"
            remedy = "check that model_file, states and actions belong together, and that the task is the recorded one"
        for entry in entries:
            what = f"the demonstration misses its goal, like all replayed ones of this file ({reasons[entry]})"
            dropped = self._dropped_noops(entry)
            if dropped:
                what += f"; replay.noops: {self.replay.noops} leaves out {dropped} of its {entry.steps} actions"
            yield str(PipelineError(what, where=self._place(entry), expected=expected, remedy=remedy))

    def _dropped_noops(self, entry: DemoEntry) -> int:
        actions = HDF5Source(self.root).load(entry.demo_id).actions
        return int((~kept_actions(actions, self.replay.noops)).sum())

    def _length_notes(self, entries: Sequence[DemoEntry]) -> Iterator[str]:
        """Count the demonstrations whose actions, without no-ops, take longer than an evaluation allows."""
        steps = {}
        for entry in entries:
            if exceeds_step_limit(self.task.suite, entry.steps):
                executed = entry.steps - self._dropped_noops(entry)
                if exceeds_step_limit(self.task.suite, executed):
                    steps[entry] = executed
        if steps:
            longest = max(steps, key=lambda entry: steps[entry])
            yield (
                f"{self._place(longest)}: takes {steps[longest]} control steps; {len(steps)} of {len(entries)} "
                f"demonstrations take more than the {STEP_LIMITS[self.task.suite]} that an evaluation allows, and "
                "`filter: {exceeds_step_limit: drop}` drops their episodes"
            )

    @property
    def _file(self) -> Path:
        return demo_file(self.root, self.task)

    def _place(self, entry: DemoEntry) -> str:
        return f"{self._file} data/{entry.key}"

    def limit_s(self) -> float:
        """Return the time after which the job counts as hanging.

        A replay takes about a minute at most, and each demonstration has up to four replays.
        """
        return 1800.0 + 4 * 600.0 * self.replays

    def lost(self) -> _Result:
        return (), CheckedDemos(faults=[f"{self._file}: {LOST}, so no worker reads the file"])


def _is_rejected(reason: str) -> bool:
    """Return whether a demonstration has no verdict on its goal."""
    return reason != "kept" and reason not in FAILURE_REASONS


def _changed_replays(replay: ReplayConfig) -> Iterator[ReplayConfig]:
    """Yield other settings for a run: keep all no-ops, track if open-loop replay fails, and both."""
    changes: list[dict[str, object]] = [{"noops": "keep"}, {"mode": "auto"}, {"noops": "keep", "mode": "auto"}]
    tried = {replay}
    for change in changes:
        changed = replay.model_copy(update=change)
        # If open-loop replay fails, auto tracks, which was tried already.
        if changed not in tried and not (replay.mode == "tracked" and changed.mode == "auto"):
            tried.add(changed)
            yield changed


def _in_words(replay: ReplayConfig) -> str:
    return f"replay.noops: {replay.noops} and replay.mode: {replay.mode}"


def _instruction_notes(task: Task) -> Iterator[str]:
    warning = too_long(task.instruction)
    if warning:
        yield f"{task}: {warning}"
