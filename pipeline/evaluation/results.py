"""The results of an evaluation: a record of each episode in a file of its own, and the results of several folders."""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.compute.slurm import LOGS
from pipeline.errors import PipelineError
from pipeline.evaluation.tasks import EvaluationTask, Prompt
from pipeline.files import is_temporary, read_json, refuse_other_file, write
from pipeline.grouping import grouped
from pipeline.seeding import digest

REFUSED = "refused"
"""The reason of an episode that could not begin, as its scene does not take what was drawn."""

ALIKE = {"black": "none", "initial_states": "libero", "fixture_seed": 0}
"""What results on one suite of one source must have in common to be compared, beside prompt and step limit: settings,
and what they are where a result leaves them out."""

PER_TASK = ("draws", "files of the benchmark")
"""The versions of a result that each task has its own of."""

Trial = tuple[EvaluationTask, int, str]
"""The whole task, the seed, and what was drawn: the same for results that can be compared one by one."""


@dataclass(frozen=True, kw_only=True)
class EpisodeResult(EvaluationTask):
    """One episode: its task, and what came of it; JSON-serialisable.

    Attributes:
        component: as drawn, where the scene refused the first draw.
        episode: names it by what it is made from.
        seed: of what is drawn for the task: its perturbations, and noise that is random.
        reason: why it ended, see ``Progress``; ``success`` says whether the goal was reached.
        perturbations: held-out perturbations as they were used.
        policy, identity: the policy's name, and what is the same for the same policy alone.
        settings: what held for all episodes, and what the policy looks at.
        versions: what computed it, by name: recipes, packages, machine code, content of the benchmark's files, first
            draws, OpenGL.
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
        task = EvaluationTask(**{field.name: getattr(self, field.name) for field in fields(EvaluationTask)})
        return task, self.seed, json.dumps(self.perturbations, sort_keys=True)


_RESULT = TypeAdapter(EpisodeResult)


@dataclass(frozen=True)
class EpisodeFiles:
    """``<folder>/episodes/<episode>.json``: a file that exists is complete, so a run goes on where it was killed.

    ``<folder>/videos/<episode>.mp4`` is there for some, and then before the episode's own file.
    """

    folder: Path

    def path(self, episode: str) -> Path:
        return self.folder / "episodes" / f"{episode}.json"

    def video(self, episode: str) -> Path:
        return self.folder / "videos" / f"{episode}.mp4"

    def refuse_other_folder(self) -> None:
        """Reject a folder that has files and no results, such as a checkpoint's, and another program's summary.

        Raises:
            PipelineError: naming the folder or the file.
        """
        refuse_other_file(self.folder / "summary.json", '"by_axis": ')
        if not self.folder.exists() or (self.folder / "episodes").is_dir():
            return
        # Workers of a cluster have files of their own there; an evaluation without any result has its summary.
        names = [entry.name for entry in self.folder.iterdir() if not is_temporary(entry.name)]
        if set(names) - {"summary.json", LOGS.parts[0]}:
            raise PipelineError(
                f"holds files and no results of an evaluation: {', '.join(sorted(names)[:3])}",
                where=self.folder,
                expected="a new or empty folder, or one of an earlier evaluation",
                remedy="name another folder",
            )

    def save(self, row: EpisodeResult) -> None:
        write(self.path(row.episode), json.dumps(asdict(row), sort_keys=True) + "\n")

    def row(self, episode: str) -> EpisodeResult | None:
        """One episode, if it is there."""
        return _read(self.path(episode)) if self.path(episode).exists() else None

    def rows(self) -> list[EpisodeResult]:
        """All episodes, in the order of their names.

        Raises:
            PipelineError: when a file is not one of an episode, or of another version of this project.
        """
        return [_read(path) for path in sorted((self.folder / "episodes").glob("*.json"))]


def _read(path: Path) -> EpisodeResult:
    content = read_json(path, "run the evaluation again")
    try:
        return _RESULT.validate_python(content)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        raise PipelineError(
            f"not a result as this version writes it ({'; '.join(faults[:3])})",
            where=path,
            expected="one record of an episode, with its policy's identity, its prompt and its limit",
            remedy="evaluate again into another folder",
        ) from error


Stored = tuple[EpisodeResult, EpisodeFiles]
"""A result, and the files that it is one of."""


def stored(folders: Iterable[Path]) -> list[Stored]:
    """The results of all folders.

    Raises:
        PipelineError: when one has none.
    """
    found: list[Stored] = []
    for files in map(EpisodeFiles, folders):
        rows = files.rows()
        if not rows:
            expected = "a folder that `python -m pipeline evaluate` wrote results into"
            raise PipelineError("no results", where=files.folder, expected=expected)
        found += [(row, files) for row in rows]
    return found


def one_setting(found: Sequence[Stored]) -> dict[str, Any]:
    """What held for all of some results, which are of one policy; empty where there is none.

    Raises:
        PipelineError: when two are of several policies or settings, with their files and what differs.
    """
    _agree(
        (("", {"identity": row.identity, **row.settings}, files.path(row.episode)) for row, files in found),
        "results of several policies or settings",
        expected="one policy under one setting",
        remedy="give each a folder of its own; evaluate a server that has changed under another --label",
    )
    return found[0][0].settings if found else {}


def refuse_different(found: Iterable[Stored], across: Collection[str] | None = None) -> None:
    """Have results that are compared made under one prompt, limit, view and start in each suite of each source.

    Args:
        across: which of them are what is compared; None where none can be.

    Raises:
        PipelineError: when two were not, with their files and what differs.
    """

    def alike(row: EpisodeResult) -> dict[str, object]:
        settings = {name: row.settings.get(name, default) for name, default in ALIKE.items()}
        facts = {"prompt": row.prompt, "step_limit": row.step_limit, **settings}
        return {name: value for name, value in facts.items() if name not in (across or ())}

    choice = "; where the difference is what you compare, --across prompt, --across step_limit or --across black"
    _agree(
        ((f"{row.source}/{row.suite}", alike(row), files.path(row.episode)) for row, files in found),
        "these results cannot be compared, on ",
        expected="one prompt, one step limit, the same black views and starts for all that is compared",
        remedy=f"evaluate both alike, or leave one of the folders out{'' if across is None else choice}",
    )


def refuse_shared_names(policies: Iterable[tuple[str, str, Path]]) -> None:
    """Have each name mean one policy.

    Args:
        policies: name, identity, and the file or folder that results are in or go to.

    Raises:
        PipelineError: when one name has two identities.
    """
    _agree(
        ((repr(name), {"identity": identity}, where) for name, identity, where in policies),
        "two policies have the name ",
        expected="one policy under one name",
        remedy="evaluate one of them under another --label into another folder, or leave out the other's folder",
    )


def _agree(found: Iterable[tuple[str, Mapping[str, object], Path]], what: str, expected: str, remedy: str) -> None:
    """Have facts that go by one name be the same.

    Args:
        found: name, facts, and the file that has them.
        what: is said of two that differ, before their name.
    """
    known: dict[str, tuple[Mapping[str, object], Path]] = {}
    for name, facts, file in found:
        earlier, where = known.setdefault(name, (facts, file))
        both = [(fact, earlier.get(fact), facts.get(fact)) for fact in {**earlier, **facts}]
        if differing := [f"{fact} {one} and {other}" for fact, one, other in both if one != other]:
            raise PipelineError(
                f"{what}{name}: {', '.join(differing)}", where=f"{where} and {file}", expected=expected, remedy=remedy
            )


@dataclass(frozen=True)
class Evaluated:
    """One policy under one set of settings.

    Attributes:
        name: the policy's, with the settings in which it differs from another of the same name.
        rows: its episodes, without those that no policy acted in.
        videos: those that there are, by the name of the episode.
        refused: how many episodes could not begin, as their scene did not take what was drawn.
    """

    name: str
    settings: Mapping[str, Any]
    rows: Sequence[EpisodeResult]
    videos: Mapping[str, Path]
    refused: int

    def of(self, source: str) -> list[EpisodeResult]:
        """Its episodes on the tasks of one source."""
        return [row for row in self.rows if row.source == source]


def read(folders: Sequence[Path], across: Collection[str] = ()) -> list[Evaluated]:
    """Read the folders that ``evaluate`` wrote; what several of them hold counts once.

    Raises:
        PipelineError: when a folder has no results, results cannot be compared, two results of an episode differ, a
            task has two episodes under the same settings, or two policies have one name.
    """
    found = stored(folders)
    refuse_shared_names((row.policy, row.identity, files.folder) for row, files in found)
    refuse_different(found, across)
    _agree(
        (
            (
                f"{row} by {row.policy}, episode {row.episode}",
                {name: getattr(row, name) for name in ("success", "reason", "steps")},
                files.path(row.episode),
            )
            for row, files in found
        ),
        "two results of ",
        expected="one result of each episode, the same wherever it was run",
        remedy="leave one of the folders out; run the one again that other versions of the packages made, or give each "
        "of two policies behind a server a --label of its own",
    )
    once = [first for first, *_ in grouped((one[0].episode, one) for one in found).values()]
    evaluated = []
    for of_policy in grouped((one[0].identity, one) for one in once).values():
        alike = grouped((digest(one[0].settings), one) for one in of_policy).values()
        evaluated += [_evaluated(group, [other[0][0] for other in alike]) for group in alike]
    return evaluated


def _evaluated(group: Sequence[Stored], alike: Sequence[EpisodeResult]) -> Evaluated:
    """Results of one policy under one set of settings.

    Args:
        alike: an episode of the policy under each of its sets of settings; it has the first of its names.

    Raises:
        PipelineError: when a task has two episodes.
    """
    acted = [(row, files) for row, files in group if row.reason != REFUSED]
    _agree(
        ((f"{row} by {row.policy}", {"episode": row.episode}, files.path(row.episode)) for row, files in acted),
        "a task counts twice: ",
        expected="one episode of each task",
        remedy="move one of the two files into another folder",
    )
    settings = group[0][0].settings
    differing = [key for key in settings if any(row.settings.get(key) != settings[key] for row in alike)]
    videos = {row.episode: files.video(row.episode) for row, files in group}
    return Evaluated(
        name=", ".join([alike[0].policy, *(f"{key.replace('_', ' ')} {settings[key]}" for key in differing)]),
        settings=settings,
        rows=[row for row, _ in acted],
        videos={episode: path for episode, path in videos.items() if path.is_file()},
        refused=len(group) - len(acted),
    )
