"""Results of an evaluation: one file per episode, and the results of several folders."""

import csv
import io
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline import outputs
from pipeline.errors import PipelineError
from pipeline.evaluation.tasks import EvaluationTask, Prompt
from pipeline.files import is_temporary, read_json, write
from pipeline.grouping import grouped
from pipeline.seeding import digest

SUMMARY = "summary.json"
"""File with an evaluation's summary, in its folder."""

REJECTED = "refused"
"""Reason of an episode that could not begin, because its scene rejects the perturbation."""

ALIKE = {"actions": "delta", "black": "none", "initial_states": "libero", "fixture_seed": 0}
"""Settings, and their values if a result leaves them out. Results on one suite of one source can be compared only if
these settings, the prompt and the step limit are equal."""

ACROSS = ("prompt", "step_limit", "black")
"""Settings in which compared results may differ if a user asks for it."""

PER_TASK = ("draws", "files of the benchmark", "definition of the task", "demonstration")
"""Versions of a result that differ between tasks."""

RECORDED = ("pipeline", "vla-eval")
"""Versions of a result that do not decide whether the result is up to date."""

TABLE = (
    "source",
    "suite",
    "name",
    "axis",
    "component",
    "level",
    "number",
    "success",
    "reason",
    "steps",
    "seed",
    "episode",
)
"""Columns of ``episodes.csv``."""

Trial = tuple[EvaluationTask, int, str]
"""Task, seed and perturbations. Results of two policies can be compared one by one if their trials are equal."""


@dataclass(frozen=True, kw_only=True)
class EpisodeResult(EvaluationTask):
    """Result of one episode, with its task; JSON-serialisable.

    Attributes:
        component: component that was used. It differs from the task's if the scene rejected the first perturbation.
        episode: name of the episode, a digest of its inputs.
        seed: seed of the task's perturbations and of random noise.
        success: True if the goal was reached.
        reason: reason why the episode ended, see ``Progress``.
        looks: number of observations.
        perturbations: held-out perturbations that were used.
        policy: the policy's name.
        identity: identity of the policy, equal for equal policies only.
        settings: settings of all episodes, and the parts of an observation that the policy uses.
        versions: name to version of everything that computed the result: recipes, packages, machine code, content of
            the benchmark's files, first perturbations, OpenGL.
    """

    episode: str
    prompt: Prompt
    instruction: str
    step_limit: int
    seed: int
    success: bool
    reason: str
    steps: int
    looks: int
    perturbations: list[dict[str, Any]]
    policy: str
    identity: str
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def trial(self) -> Trial:
        """Return the trial of this result."""
        values = {field.name: getattr(self, field.name) for field in fields(EvaluationTask)}
        task = EvaluationTask(**values)
        return task, self.seed, json.dumps(self.perturbations, sort_keys=True)


_RESULT = TypeAdapter(EpisodeResult)


@dataclass(frozen=True)
class EpisodeFiles:
    """Files of the episodes in a folder.

    ``<folder>/episodes/<episode>.json`` is complete if it exists, so a killed run resumes where it stopped. Some
    episodes have ``<folder>/videos/<episode>.mp4``, which is written before the episode's own file.
    """

    folder: Path

    def path(self, episode: str) -> Path:
        """Return the path of an episode's result."""
        return self.folder / "episodes" / f"{episode}.json"

    def video(self, episode: str) -> Path:
        """Return the path of an episode's video."""
        return self.folder / "videos" / f"{episode}.mp4"

    @property
    def table(self) -> Path:
        """Return the path of the table of the episodes."""
        return self.folder / "episodes.csv"

    def write_table(self, rows: Iterable[EpisodeResult]) -> None:
        """Write a line for each episode, with the columns ``TABLE``."""
        lines = io.StringIO()
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(TABLE)
        for row in rows:
            writer.writerow([getattr(row, column) for column in TABLE])
        outputs.write(self.table, lines.getvalue())

    def reject_other_folder(self) -> None:
        """Reject a folder with files but without results, such as a checkpoint's, and another program's summary.

        Raises:
            PipelineError: if the folder is rejected; it names the folder or the file.
        """
        outputs.reject_other_file(self.folder / SUMMARY)
        outputs.reject_other_file(self.table)
        if not self.folder.exists() or (self.folder / "episodes").is_dir():
            return
        # An evaluation without results writes its summary, and may be killed after the video of its first episode.
        names = [entry.name for entry in self.folder.iterdir() if not is_temporary(entry.name)]
        if set(names) - {SUMMARY, self.table.name, "videos", outputs.RECORD}:
            raise PipelineError(
                f"the folder has files but no results of an evaluation: {', '.join(sorted(names)[:3])}",
                where=self.folder,
                expected="a new or empty folder, or one of an earlier evaluation",
                remedy="name another folder",
            )

    def save(self, row: EpisodeResult) -> None:
        """Write the result of an episode."""
        write(self.path(row.episode), json.dumps(asdict(row), sort_keys=True) + "\n")

    def row(self, episode: str) -> EpisodeResult | None:
        """Read the result of an episode; return `None` if there is none.

        Raises:
            PipelineError: if the file is not a result of this version.
        """
        return _read(self.path(episode)) if self.path(episode).exists() else None

    def rows(self) -> list[EpisodeResult]:
        """Read the results of all episodes, ordered by episode name.

        Raises:
            PipelineError: if a file is not the result of an episode, or comes from another version of this project.
        """
        return [_read(path) for path in sorted((self.folder / "episodes").glob("*.json"))]


def _read(path: Path) -> EpisodeResult:
    """Read the result of an episode from a file.

    Raises:
        PipelineError: if the file is not a result of this version.
    """
    content = read_json(path, "run the evaluation again")
    try:
        return _RESULT.validate_python(content)
    except ValidationError as error:
        faults: list[str] = []
        for fault in error.errors():
            location = ".".join(map(str, fault["loc"]))
            faults.append(f"{location}: {fault['msg']}")
        raise PipelineError(
            f"the file is not a result of this version ({'; '.join(faults[:3])})",
            where=path,
            expected="one record of an episode, with its policy's identity, its prompt and its limit",
            remedy="evaluate again into another folder",
        ) from error


Stored = tuple[EpisodeResult, EpisodeFiles]
"""Result, and the files of its folder."""


def stored(folders: Iterable[Path]) -> list[Stored]:
    """Read the results of all folders.

    Raises:
        PipelineError: if a folder has no results.
    """
    results: list[Stored] = []
    for files in map(EpisodeFiles, folders):
        rows = files.rows()
        if not rows:
            expected = "a folder that `python -m pipeline evaluate` wrote results into"
            raise PipelineError("the folder has no results", where=files.folder, expected=expected)
        results += [(row, files) for row in rows]
    return results


def one_setting(results: Sequence[Stored]) -> dict[str, Any]:
    """Return the settings of results, which must have one policy and one set of settings; empty without results.

    Raises:
        PipelineError: if two results differ in policy or settings; it names their files and the differences.
    """
    _agree(
        (("", {"identity": row.identity, **row.settings}, files.path(row.episode)) for row, files in results),
        "the results have several policies or settings",
        expected="one policy under one setting",
        remedy="give each policy and setting a folder of its own; evaluate a changed server under another --label",
    )
    return results[0][0].settings if results else {}


def reject_different(results: Iterable[Stored], across: Collection[str] | None = None) -> None:
    """Reject results that cannot be compared.

    In each suite of each source, results must have equal prompts, step limits, actions, black views and starts.

    Args:
        across: the settings that are compared and so may differ; `None` if the caller offers no such comparison.

    Raises:
        PipelineError: if two results differ; it names their files and the differences.
    """

    def compared(row: EpisodeResult) -> dict[str, object]:
        """Return the facts that must be equal."""
        settings = {name: row.settings.get(name, default) for name, default in ALIKE.items()}
        facts = {"prompt": row.prompt, "step_limit": row.step_limit, **settings}
        return {name: value for name, value in facts.items() if name not in (across or ())}

    options = " or ".join(f"--across {setting}" for setting in ACROSS)
    choice = f"; or compare across the difference by {options}"
    _agree(
        ((f"{row.source}/{row.suite}", compared(row), files.path(row.episode)) for row, files in results),
        "these results cannot be compared on ",
        expected="equal prompts, step limits, actions, black views and starts of all compared results",
        remedy=f"evaluate both with equal settings, or leave one of the folders out{'' if across is None else choice}",
    )


def reject_repeated_tasks(results: Iterable[Stored]) -> None:
    """Reject two episodes of one task among results of one policy under one set of settings.

    Raises:
        PipelineError: if a task has two episodes; it names their files.
    """
    _agree(
        ((f"{row} by {row.policy}", {"episode": row.episode}, files.path(row.episode)) for row, files in results),
        "a task counts twice: ",
        expected="one episode of each task",
        remedy="move one of the two files into another folder",
    )


def reject_repeated_models(results: Sequence[Sequence[Stored]]) -> None:
    """Reject one model in the place of two.

    Args:
        results: results of each model.

    Raises:
        PipelineError: if two of them are of one policy; it names their folders.
    """
    folder_of: dict[str, Path] = {}
    for model_results in results:
        row, files = model_results[0]
        if row.identity in folder_of:
            raise PipelineError(
                f"both folders have results of {row.policy}, which would count as two models",
                where=f"{folder_of[row.identity]} and {files.folder}",
                expected="one folder of each model",
                remedy="leave one of the folders out; copy results of several machines into one folder",
            )
        folder_of[row.identity] = files.folder


def reject_shared_names(policies: Iterable[tuple[str, str, Path]]) -> None:
    """Reject two policies with one name.

    Args:
        policies: name, identity, and the file or folder of the policy's results.

    Raises:
        PipelineError: if one name has two identities.
    """
    _agree(
        ((repr(name), {"identity": identity}, where) for name, identity, where in policies),
        "two policies have the name ",
        expected="one policy under one name",
        remedy="evaluate one of them under another --label into another folder, or leave out the other's folder",
    )


def _agree(
    named_facts: Iterable[tuple[str, Mapping[str, object], Path]], what: str, expected: str, remedy: str
) -> None:
    """Reject different facts under one name.

    Args:
        named_facts: name, facts, and the file that contains the facts.
        what: beginning of the error message, before the name.

    Raises:
        PipelineError: if facts differ; it names the two files and the differences.
    """
    first_facts: dict[str, tuple[Mapping[str, object], Path]] = {}
    for name, facts, file in named_facts:
        earlier, where = first_facts.setdefault(name, (facts, file))
        differing: list[str] = []
        for fact in {**earlier, **facts}:
            if earlier.get(fact) != facts.get(fact):
                differing.append(f"{fact} {earlier.get(fact)} and {facts.get(fact)}")
        if differing:
            raise PipelineError(
                f"{what}{name}: {', '.join(differing)}", where=f"{where} and {file}", expected=expected, remedy=remedy
            )


def versions_of(rows: Iterable[EpisodeResult]) -> dict[str, list[str]]:
    """List the versions of results by name, without versions that differ between tasks."""
    versions: dict[str, set[str]] = {}
    for row in rows:
        for name, version in row.versions.items():
            if name not in PER_TASK:
                versions.setdefault(name, set()).add(version)
    return {name: sorted(found) for name, found in versions.items()}


def mixed_versions(rows: Iterable[EpisodeResult]) -> dict[str, list[str]]:
    """List the versions of results by name, for names with several versions; ``RECORDED`` is left out."""
    named = versions_of(rows)
    return {name: found for name, found in named.items() if len(found) > 1 and name not in RECORDED}


@dataclass(frozen=True)
class Evaluated:
    """Results of one policy under one set of settings.

    Attributes:
        name: the policy's name, with the settings that differ from the policy's other results.
        rows: the episodes, without those in which no policy acted.
        videos: name of an episode to its video, for episodes with a video.
        rejected: number of episodes that could not begin, because their scene rejected the perturbation.
    """

    name: str
    settings: Mapping[str, Any]
    rows: Sequence[EpisodeResult]
    videos: Mapping[str, Path]
    rejected: int

    def from_source(self, source: str) -> list[EpisodeResult]:
        """Return the episodes on the tasks of one source."""
        return [row for row in self.rows if row.source == source]


def read(folders: Sequence[Path], across: Collection[str] = ()) -> list[Evaluated]:
    """Read the folders that ``evaluate`` wrote; an episode in several folders counts once.

    Raises:
        PipelineError: if a folder has no results, or results cannot be compared. Results of an episode must not differ,
            a task has one episode under the same settings, and policies have different names.
    """
    results = stored(folders)
    reject_shared_names((row.policy, row.identity, files.folder) for row, files in results)
    reject_different(results, across)
    outcomes: list[tuple[str, Mapping[str, object], Path]] = []
    for row, files in results:
        episode_name = f"{row} by {row.policy}, episode {row.episode}"
        outcome = {"success": row.success, "reason": row.reason, "steps": row.steps}
        outcomes.append((episode_name, outcome, files.path(row.episode)))
    _agree(
        outcomes,
        "two results of ",
        expected="one result of each episode, equal in all folders",
        remedy="leave one of the folders out; evaluate again the results of other package versions, or give each of "
        "two policies behind a server a --label of its own",
    )
    by_episode = grouped((result[0].episode, result) for result in results)
    once = [same_episode[0] for same_episode in by_episode.values()]
    by_policy = grouped((result[0].identity, result) for result in once)
    evaluated: list[Evaluated] = []
    for of_policy in by_policy.values():
        by_settings = grouped((digest(result[0].settings), result) for result in of_policy)
        first_rows = [group[0][0] for group in by_settings.values()]
        evaluated += [_evaluated(group, first_rows) for group in by_settings.values()]
    return evaluated


def _evaluated(group: Sequence[Stored], row_of_each_setting: Sequence[EpisodeResult]) -> Evaluated:
    """Collect the results of one policy under one set of settings.

    Args:
        row_of_each_setting: an episode of the policy under each of its sets of settings; the first one gives the
            policy's name.

    Raises:
        PipelineError: if a task has two episodes.
    """
    acted = [(row, files) for row, files in group if row.reason != REJECTED]
    reject_repeated_tasks(acted)
    settings = group[0][0].settings
    name_parts = [row_of_each_setting[0].policy]
    for key, value in settings.items():
        if any(row.settings.get(key) != value for row in row_of_each_setting):
            text = value[:8] if key == "plan" else value  # The plan is given by a long digest.
            name_parts.append(f"{key.replace('_', ' ')} {text}")
    videos = {row.episode: files.video(row.episode) for row, files in group}
    return Evaluated(
        name=", ".join(name_parts),
        settings=settings,
        rows=[row for row, _ in acted],
        videos={episode: path for episode, path in videos.items() if path.is_file()},
        rejected=len(group) - len(acted),
    )
