"""Selection of a dataset's episodes, their order, and their division into splits and slices."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, pairwise
from typing import NamedTuple

from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.libero.tasks import IN_SCENE
from pipeline.seeding import digest
from pipeline.types import Episode


def count_for_validation(share: float, demonstrations: int) -> int:
    """Return the number of a task's demonstrations in ``val``: rounded half to even, and 0 for a single one."""
    return round(share * demonstrations) if demonstrations > 1 else 0


def too_few(share: float, where: str) -> PipelineError:
    """Return the error that no task, in total or in a suite, has enough demonstrations for a share above 0."""
    least = next(number for number in count(max(2, int(0.5 / share))) if count_for_validation(share, number))
    return PipelineError(
        f"no task has enough demonstrations for {share:g} of them to go into the split val",
        where=where,
        expected=f"{least} or more demonstrations of a task; expansions of one demonstration count as one",
        remedy="use more demonstrations, a larger share, or 0",
    )


Load = Callable[[str], Episode]
"""Episode id to episode; picklable, called in worker processes."""


@dataclass(frozen=True)
class Piece:
    """Consecutive episodes of a dataset, which one worker writes.

    Attributes:
        path: path of its file or folder, below the work folder.
        number: number of preceding pieces.
        first_episode, first_step: number of preceding episodes and steps of the dataset.
        steps: number of its own steps.
        tasks: each of its instructions to the instruction's number in the dataset.
    """

    path: str
    ids: Sequence[str]
    split: str = "train"
    number: int = 0
    first_episode: int = 0
    first_step: int = 0
    steps: int = 0
    tasks: Mapping[str, int] = field(default_factory=dict)


class EpisodeFacts(NamedTuple):
    """Facts about an episode that are known before it is loaded; they decide its place in a dataset.

    Attributes:
        content: fingerprint that changes with anything that ``load`` would return.
        demo: its demonstration, ``<suite>/<task>/<key>``.
        origin: identifier that all demonstrations generated from one human demonstration share.
        instruction: the text that the policy is prompted with.
        scene: name of the task in whose scene it is carried out, if the demonstration has another scene.
    """

    suite: str
    content: str = ""
    demo: str = ""
    instruction: str = ""
    steps: int = 0
    origin: str = ""
    scene: str = ""

    @property
    def task_file(self) -> str:
        """Name of the file of its task, ``<suite>/<task>``, with the scene if the task is carried to another one."""
        task = self.demo.rpartition("/")[0]
        return f"{task}{IN_SCENE}{self.scene}" if self.scene else task


@dataclass(frozen=True)
class Episodes:
    """Content of a dataset.

    Attributes:
        facts: episode id to the facts about the episode, in the order of writing. The order is shuffled, because
            readers read a dataset in order.
    """

    facts: Mapping[str, EpisodeFacts]
    load: Load

    @property
    def ids(self) -> list[str]:
        return list(self.facts)

    def by_split(self, validation: float) -> dict[str, list[str]]:
        """Divide the episodes into ``train`` and, with a validation share above 0, ``val``, in the order of ``ids``.

        All episodes of a demonstration are in one split: no perturbed episode has its clean twin, or equal actions, in
        the other split. All demonstrations generated from one are in one split too, because their actions
        may be equal. At least one origin of each task stays in ``train``.

        Args:
            validation: share of each task's origins, by number, rounded; chosen by a hash of a demonstration's name.

        Raises:
            PipelineError: when there are no episodes, or the demonstrations are too few for a validation split.
        """
        if not self.facts:
            raise PipelineError(
                "there are no episodes to write",
                expected="1 or more",
                remedy="list the kept episodes by `python -m pipeline status CONFIG`; widen export.where, or filter",
            )
        if not validation:
            return {"train": self.ids}
        chosen = demos_for_validation(self.facts.values(), validation)
        if not chosen:
            raise too_few(validation, "export.<format>.validation")
        splits: dict[str, list[str]] = {"train": [], "val": []}
        for episode_id, facts in self.facts.items():
            splits["val" if facts.demo in chosen else "train"].append(episode_id)
        return splits


def demos_for_validation(episodes: Iterable[EpisodeFacts], share: float) -> set[str]:
    """Choose the demonstrations of the split ``val``: all those of the given share of each task's origins."""
    demos_of_task: dict[str, dict[str, set[str]]] = {}
    for facts in episodes:
        task = facts.demo.rpartition("/")[0]
        demos_of_task.setdefault(task, {}).setdefault(facts.origin or facts.demo, set()).add(facts.demo)
    chosen: set[str] = set()
    for demos_of_origin in demos_of_task.values():
        origins = sorted(demos_of_origin.values(), key=lambda demos: min(digest("validation", demo) for demo in demos))
        chosen.update(*origins[: count_for_validation(share, len(origins))])
    return chosen


def number_pieces(slices: Mapping[str, tuple[str, Sequence[str]]], facts: Mapping[str, EpisodeFacts]) -> list[Piece]:
    """Return the pieces of one dataset, with the numbers of preceding episodes and steps that their files state.

    Args:
        slices: path of each piece, in order, to its split and its episodes.
        facts: episode id to the facts about the episode.
    """
    pieces: list[Piece] = []
    tasks: dict[str, int] = {}
    for path, (split_name, ids) in slices.items():
        before = pieces[-1] if pieces else Piece("", ())
        numbers: dict[str, int] = {}
        for episode_id in ids:
            text = facts[episode_id].instruction
            numbers[text] = tasks.setdefault(text, len(tasks))
        piece = Piece(
            path,
            ids,
            split_name,
            number=len(pieces),
            first_episode=before.first_episode + len(before.ids),
            first_step=before.first_step + before.steps,
            steps=sum(facts[episode_id].steps for episode_id in ids),
            tasks=numbers,
        )
        pieces.append(piece)
    return pieces


def split(episode_ids: Sequence[str], pieces: int) -> list[list[str]]:
    """Divide episodes into contiguous slices whose sizes differ by at most one.

    Their concatenation keeps the caller's order. The number of slices is ``pieces``, or the number of episodes if that
    is smaller.
    """
    slices = min(pieces, len(episode_ids))
    bounds = [len(episode_ids) * k // slices for k in range(slices + 1)]
    return [list(episode_ids[start:stop]) for start, stop in pairwise(bounds)]


def by_suite(suites: Mapping[str, str], name: str) -> dict[str, list[str]]:
    """Group episodes into a set for each suite, in the caller's order, so that clients train on one suite or on all.

    Args:
        suites: episode id to LIBERO suite.
        name: prefix of the sets' names; the set of ``libero_spatial`` is ``<name>_spatial``.

    Returns:
        Set name to its episodes.
    """
    return grouped((f"{name}_{suite.removeprefix('libero_')}", episode_id) for episode_id, suite in suites.items())
