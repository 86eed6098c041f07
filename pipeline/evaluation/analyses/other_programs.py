"""Results of vla-eval's and lerobot's own LIBERO-Plus environments, read from the files of these programs."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.axes import AXES
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.evaluation.analyses.tested import Outcome, TestedPolicy, joined, limits_of, tested_policy
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.results import ACROSS, read
from pipeline.files import read_json
from pipeline.grouping import grouped
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TESTED_SUITES, TestTask

VLA_EVAL = "_aggregate.json"
"""End of the name of vla-eval's file of one benchmark (``vla_eval/results/export.py``, 0.8.0)."""

LEROBOT = "eval_info.json"
"""Name of lerobot-eval's file (``lerobot/scripts/lerobot_eval.py``, 0.6.1)."""

CATEGORIES = {
    "Camera Viewpoints": "camera",
    "Robot Initial States": "robot",
    "Language Instructions": "language",
    "Light Conditions": "light",
    "Background Textures": "background",
    "Sensor Noise": "noise",
    "Objects Layout": "layout",
}
"""Category in the benchmark's ``task_classification.json`` to the paper's dimension."""

Content = TypeVar("Content", bound=BaseModel)

LIBERO_TASKS = 10
"""Number of tasks of each of LIBERO's own suites that the benchmark perturbs."""


class _VlaEvalEpisode(BaseModel):
    """Episode in vla-eval's file: its result, and the task's plain values.

    Attributes:
        name: name of the task, which vla-eval's own classes send as the prompt.
        task_id: number of the task in LIBERO-Plus's list of the suite.
        source, task_name: fields of this project's benchmark for vla-eval.
        failure_reason: fault of the program or the server, because of which the episode has no outcome.
    """

    name: str
    suite: str
    task_id: int | None = None
    category: str | None = None
    source: str | None = None
    task_name: str | None = None
    metrics: dict[str, Any] = {}
    failure_reason: str | None = None


class _VlaEvalTask(BaseModel):
    """Task in vla-eval's file."""

    episodes: list[_VlaEvalEpisode]


class _VlaEvalConfig(BaseModel):
    """Configuration of a benchmark in vla-eval's file."""

    benchmark: str
    max_steps: int | None = None
    params: dict[str, Any] = {}


class _VlaEvalFile(BaseModel):
    """Content of vla-eval's file, as far as it is used.

    Attributes:
        partial: true if episodes of the evaluation never ran.
    """

    config: _VlaEvalConfig
    tasks: list[_VlaEvalTask]
    partial: bool = False


class _LerobotMetrics(BaseModel):
    """Outcomes of a task's episodes in lerobot-eval's file."""

    successes: list[bool]


class _LerobotTask(BaseModel):
    """Task in lerobot-eval's file: its suite, and its number in LIBERO-Plus's list of the suite."""

    model_config = ConfigDict(strict=True)

    task_group: str
    task_id: int
    metrics: _LerobotMetrics


class _LerobotFile(BaseModel):
    """Content of lerobot-eval's file, as far as it is used."""

    per_task: list[_LerobotTask]


@dataclass(frozen=True)
class _Episode:
    """Episode of another program.

    Attributes:
        prompt: kind of the prompt; `None` if the file does not state it.
        step_limit: step limit; `None` if the file does not state it.
        success: whether the episode reached its goal; `None` if it has no outcome.
        black: views that were black; other programs' own benchmarks have no such setting.
    """

    test: TestTask
    prompt: str | None
    step_limit: int | None
    success: bool | None
    black: str = "none"


def read_tested(paths: Sequence[Path]) -> list[TestedPolicy]:
    """Read the outcomes on test tasks from folders of ``evaluate``, and from results of vla-eval and lerobot-eval.

    A policy of another program has the name of the folder of its results. Prompts and step limits may differ, because
    each policy states its own.

    Args:
        paths: folders of ``evaluate``; folders or files of vla-eval (``*_aggregate.json``) and lerobot-eval
            (``eval_info.json``).

    Raises:
        PipelineError: if a path has no results on test tasks, if a file is damaged, or if two policies have one name.
    """
    folders, policies = separate(paths)
    if folders:
        evaluated = [policy for policy in map(tested_policy, read(folders, ACROSS)) if policy is not None]
        if not evaluated:
            raise PipelineError(
                "the results have no test task of LIBERO-Plus",
                where=", ".join(map(str, folders)),
                expected="results of `evaluate --source libero_plus`",
                remedy="evaluate on these tasks, or name another folder",
            )
        policies = [*evaluated, *policies]
    _reject_shared_names(policies, paths)
    return policies


def separate(paths: Sequence[Path]) -> tuple[list[Path], list[TestedPolicy]]:
    """Separate folders of ``evaluate`` from results of vla-eval and lerobot-eval, which are read.

    Returns:
        The folders, and the outcomes of the policies of other programs.

    Raises:
        PipelineError: if a file is damaged, if it has no results on test tasks, if a folder has results of several
            programs, or if two policies have one name.
    """
    folders: list[Path] = []
    policies: list[TestedPolicy] = []
    for path in paths:
        vla_eval, lerobot = _files(path)
        if vla_eval:
            policies.append(_policy(vla_eval[0].parent, "vla-eval", _vla_eval_files(vla_eval)))
        elif lerobot is not None:
            policies.append(_policy(lerobot.parent, "lerobot-eval", _lerobot_episodes(lerobot)))
        else:
            folders.append(path)
    _reject_shared_names(policies, paths)
    return folders, policies


def _reject_shared_names(policies: Sequence[TestedPolicy], paths: Sequence[Path]) -> None:
    repeated = [name for name, count in Counter(policy.name for policy in policies).items() if count > 1]
    if repeated:
        raise PipelineError(
            f"two policies have the name {repeated[0]!r}",
            where=", ".join(map(str, paths)),
            expected="different names of the folders, which name the policies of vla-eval and lerobot-eval",
            remedy="rename one of the folders, or leave one out",
        )


def _files(path: Path) -> tuple[list[Path], Path | None]:
    """Return the files of vla-eval, and the file of lerobot-eval, at a path.

    Raises:
        PipelineError: if the path is a folder with results of several programs.
    """
    if path.is_dir():
        vla_eval = sorted(path.glob(f"*{VLA_EVAL}"))
        lerobot = path / LEROBOT if (path / LEROBOT).is_file() else None
        rows = any((path / "episodes").glob("*.json"))
        if [bool(vla_eval), lerobot is not None, rows].count(True) > 1:
            raise PipelineError(
                "the folder has results of several programs",
                where=path,
                expected=f"episodes/*.json of `evaluate`, *{VLA_EVAL} of vla-eval, or {LEROBOT} of lerobot-eval",
                remedy="move the results of all programs but one to another folder",
            )
        return vla_eval, lerobot
    if path.name.endswith(VLA_EVAL):
        return [path], None
    if path.suffix == ".json":
        return [], path
    return [], None


def _policy(folder: Path, program: str, episodes: Sequence[_Episode]) -> TestedPolicy:
    """Return the outcomes of a policy of another program.

    Raises:
        PipelineError: if no episode has an outcome.
    """
    ended = [episode for episode in episodes if episode.success is not None]
    if not ended:
        raise PipelineError(
            f"none of the {len(episodes)} episodes has a result", where=folder, remedy="run the program again"
        )
    outcomes = [Outcome(episode.test.suite, episode.test.name, bool(episode.success)) for episode in ended]
    # The instruction of a language task is equal in the prompts `clean` and `benchmark`, so it does not show the kind.
    kinds = {episode.prompt for episode in ended if episode.test.axis != "language"}
    prompts = kinds or {episode.prompt for episode in ended}
    limits = [(one.test.suite, one.step_limit) for one in ended if one.step_limit is not None]
    return TestedPolicy(
        folder.resolve().name,
        outcomes,
        program,
        None if None in prompts else joined(kind for kind in prompts if kind is not None),
        limits_of(limits),
        len(episodes) - len(ended),
        joined({episode.black for episode in ended}),
    )


def _vla_eval_files(files: Sequence[Path]) -> list[_Episode]:
    """Read the episodes of one policy from vla-eval's files of several benchmarks.

    Raises:
        PipelineError: if a file is rejected, or if a task is in two files, which may be of two policies.
    """
    episodes: list[_Episode] = []
    file_of: dict[tuple[str, str], Path] = {}
    for file in files:
        of_file = _vla_eval_episodes(file)
        for episode in of_file:
            earlier = file_of.setdefault((episode.test.suite, episode.test.name), file)
            if earlier != file:
                raise PipelineError(
                    f"two files have the task {episode.test.suite}/{episode.test.name}",
                    where=f"{earlier} and {file}",
                    expected="the files of one policy in a folder, each task in one of them",
                    remedy="move the files of each policy into a folder of its own",
                )
        episodes += of_file
    return episodes


def _vla_eval_episodes(file: Path) -> list[_Episode]:
    """Read the episodes of vla-eval's file of one benchmark.

    Raises:
        PipelineError: if the file is damaged or not finished, or its benchmark is not LIBERO-Plus.
    """
    content = _parsed(_VlaEvalFile, file, "a file that vla-eval 0.8.0 wrote next to its recording")
    name = content.config.benchmark.rpartition(":")[2]
    if name not in ("LIBEROPlusBenchmark", "PerturbedLibero"):
        raise PipelineError(
            f"the file has results of {name or content.config.benchmark!r}",
            where=f"{file} config.benchmark",
            expected="LIBEROPlusBenchmark of vla-eval, or PerturbedLibero of this project",
            remedy="leave this file out, or move it to another folder",
        )
    ours = name == "PerturbedLibero"
    if content.partial:
        raise PipelineError(
            "the evaluation was not finished, and its finished tasks are no random sample of the benchmark",
            where=file,
            expected="a file of vla-eval without `partial`",
            remedy="run vla-eval again with the same --eval-id, which completes the evaluation",
        )
    settings = _settings(content.config, file) if ours else None
    limit = content.config.max_steps or content.config.params.get("max_steps")
    episodes = []
    for task in content.tasks:
        for episode in task.episodes:
            where = f"{file} {episode.suite}/{episode.name}"
            test = _our_test(episode, where) if ours else _their_test(episode, where)
            if settings is not None:
                # vla-eval ends an episode at its own limit, too, if that is lower.
                own_limit = settings.step_limit(test.suite)
                prompt, step_limit = str(settings.prompt), min(own_limit, limit or own_limit)
            else:
                prompt, step_limit = _kind_of_prompt(test, episode.name), limit or STEP_LIMITS[test.suite]
            ended = not episode.failure_reason and "success" in episode.metrics
            success = bool(episode.metrics["success"]) if ended else None
            black = "none" if settings is None else settings.black
            episodes.append(_Episode(test, prompt, step_limit, success, black))
    return episodes


def _settings(config: _VlaEvalConfig, file: Path) -> EpisodeSettings:
    """Return the settings of this project's benchmark for vla-eval.

    Raises:
        PipelineError: if they are not settings of this version.
    """
    try:
        return EpisodeSettings.model_validate(config.params.get("settings") or {})
    except ValidationError as error:
        raise PipelineError(
            f"the file has other settings ({_first_fault(error)})",
            where=f"{file} config.params.settings",
            expected="settings of this version",
            remedy="run vla-eval again with this version",
        ) from error


def _our_test(episode: _VlaEvalEpisode, where: str) -> TestTask:
    """Return the test task of an episode of this project's benchmark for vla-eval.

    Raises:
        PipelineError: if the episode has another source of tasks.
    """
    if episode.source != "libero_plus" or episode.task_name is None:
        raise PipelineError(
            f"the episode's task is of the source {episode.source}",
            where=where,
            expected="source libero_plus",
            remedy="move the file to another folder: LIBERO-Plus's table has its test tasks alone",
        )
    return benchmark.load().find(episode.suite, episode.task_name)


def _their_test(episode: _VlaEvalEpisode, where: str) -> TestTask:
    """Return the test task of an episode of vla-eval's own benchmark.

    Raises:
        PipelineError: if the number is missing, or is not that of a task with the episode's category.
    """
    if episode.task_id is None:
        raise PipelineError("the episode has no task_id", where=where, remedy="run vla-eval 0.8.0 without --no-save")
    test = _numbered_test(episode.suite, episode.task_id, where)
    if episode.category is not None and CATEGORIES.get(episode.category) != AXES[test.axis].dimension:
        raise PipelineError(
            f"the episode's category is {episode.category!r}, but task {episode.task_id} is {test.name}",
            where=where,
            expected="the order of tasks of LIBERO-Plus's libero_suite_task_map.py",
            remedy="evaluate with the released LIBERO-Plus",
        )
    return test


def _kind_of_prompt(test: TestTask, prompt: str) -> str:
    """Return the kind of a prompt: the first kind that gives it, or ``other``."""
    if test.axis == "language" or prompt == libero_plus.instruction(test, "benchmark"):
        return "benchmark"
    return "clean" if prompt == libero_plus.instruction(test, "clean") else "other"


def _lerobot_episodes(file: Path) -> list[_Episode]:
    """Read the episodes of lerobot-eval's file.

    The file names a task by suite and number, and states neither prompt nor step limits.

    Raises:
        PipelineError: if the file is damaged, or if its tasks may be LIBERO's.
    """
    content = _parsed(_LerobotFile, file, "the file that lerobot-eval of lerobot 0.6 wrote, with per_task")
    # LIBERO and LIBERO-Plus number their tasks from 0, and the file does not name the environment.
    if all(task.task_id < LIBERO_TASKS for task in content.per_task):
        raise PipelineError(
            f"all numbers of tasks are below {LIBERO_TASKS}, so the tasks may be LIBERO's own",
            where=f"{file} per_task",
            expected="results of lerobot's environment libero_plus with further tasks",
            remedy="evaluate all tasks of a suite; for this project's environment, name the folder of --env.out",
        )
    episodes = []
    for task in content.per_task:
        test = _numbered_test(task.task_group, task.task_id, f"{file} per_task")
        episodes += [_Episode(test, None, None, success) for success in task.metrics.successes]
    return episodes


def _numbered_test(suite: str, number: int, where: str) -> TestTask:
    """Return the test task of a suite by its number in LIBERO-Plus's list, counted from 0.

    Raises:
        PipelineError: if there is no such suite or number.
    """
    tests = _tests_by_suite().get(suite)
    if tests is None:
        raise PipelineError(
            f"LIBERO-Plus has no suite {suite!r}",
            where=where,
            expected=" or ".join(TESTED_SUITES),
            remedy="leave the results of this suite out",
        )
    if not 0 <= number < len(tests):
        raise PipelineError(
            f"{suite} has no task {number}",
            where=where,
            expected=f"a number from 0 to {len(tests) - 1}",
            remedy="evaluate with the released LIBERO-Plus",
        )
    return tests[number]


@cache
def _tests_by_suite() -> dict[str, list[TestTask]]:
    """Return suite to its test tasks, in LIBERO-Plus's order."""
    return grouped((test.suite, test) for test in benchmark.load().tasks)


def _parsed(kind: type[Content], file: Path, expected: str) -> Content:
    """Read a JSON file of another program.

    Raises:
        PipelineError: if the file is missing, damaged, or has other fields.
    """
    try:
        return kind.model_validate(read_json(file, "run the program again"))
    except ValidationError as error:
        raise PipelineError(
            f"the file has other fields ({_first_fault(error)})",
            where=file,
            expected=expected,
            remedy="name the folder of the results, or run the program again",
        ) from error


def _first_fault(error: ValidationError) -> str:
    """Return the place and the message of the first fault."""
    fault = error.errors()[0]
    location = ".".join(map(str, fault["loc"]))
    return f"{location}: {fault['msg']}"
