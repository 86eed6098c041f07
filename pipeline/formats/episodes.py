"""The episodes of a dataset: which, in which order, in which splits and slices."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from pipeline.errors import PipelineError
from pipeline.export_config import too_few, validating
from pipeline.grouping import grouped
from pipeline.seeding import digest
from pipeline.types import Episode

Load = Callable[[str], Episode]
"""Episode id to episode; picklable, called in worker processes."""


@dataclass(frozen=True)
class Piece:
    """Some episodes of a dataset, in a row, which one worker writes.

    Attributes:
        path: of its file or folder, below the work folder.
        number: how many pieces come before.
        first_episode, first_step: how many episodes and steps of the dataset come before.
        tasks: each of its instructions to the number of it among the dataset's.
    """

    path: str
    ids: Sequence[str]
    split: str = "train"
    number: int = 0
    first_episode: int = 0
    first_step: int = 0
    steps: int = 0
    tasks: Mapping[str, int] = field(default_factory=dict)


class Known(NamedTuple):
    """What is known of an episode before it is loaded.

    Attributes:
        content: changes with anything that ``load`` would return.
        demo: its demonstration, ``<suite>/<task>/<key>``.
        origin: the same for all demonstrations that were made from one human demonstration.
        instruction: the text that the policy is prompted with.
    """

    suite: str
    content: str = ""
    demo: str = ""
    instruction: str = ""
    steps: int = 0
    origin: str = ""


@dataclass(frozen=True)
class Episodes:
    """What a dataset is made of.

    Attributes:
        known: episode id to what is known of it, in the order in which they are written: shuffled, because readers walk
            a dataset in order.
    """

    known: Mapping[str, Known]
    load: Load

    @property
    def ids(self) -> list[str]:
        return list(self.known)

    def by_split(self, validation: float) -> dict[str, list[str]]:
        """``train``, and ``val`` where a share is for validation, to their episodes in the order of ``ids``.

        A demonstration goes there with all of its episodes, so that no perturbed episode has its clean twin, or the
        same actions, on the other side. So do all demonstrations that were made from one: their actions may be equal.
        Of each task at least one origin stays to train on.

        Args:
            validation: share of each task's origins, by number, rounded; chosen by a hash of a demonstration's name.

        Raises:
            PipelineError: when there is nothing to write, or the demonstrations are too few for a validation split.
        """
        if not self.known:
            raise PipelineError(
                "no episodes to write",
                expected="1 or more",
                remedy="`python -m pipeline status` says what reached its goal; else widen export.where, or filter",
            )
        if not validation:
            return {"train": self.ids}
        chosen = self._origins_for(validation)
        if not chosen:
            raise too_few(validation, "export.<format>.validation")
        splits = grouped(("val" if _origin(known) in chosen else "train", one) for one, known in self.known.items())
        return {split: splits[split] for split in ("train", "val")}

    def _origins_for(self, validation: float) -> set[tuple[str, str]]:
        """Choose the given share of each task's origins."""
        places = grouped((_origin(known), digest("validation", known.demo)) for known in self.known.values())
        by_task = grouped((task, (min(digests), (task, origin))) for (task, origin), digests in places.items())
        chosen: set[tuple[str, str]] = set()
        for origins in by_task.values():
            chosen |= {origin for _, origin in sorted(origins)[: validating(validation, len(origins))]}
        return chosen


def _origin(known: Known) -> tuple[str, str]:
    """A task, and which of its human demonstrations an episode comes from."""
    return known.demo.rpartition("/")[0], known.origin or known.demo


def in_a_row(slices: Mapping[str, tuple[str, Sequence[str]]], known: Mapping[str, Known]) -> list[Piece]:
    """The pieces of one dataset whose files say how many episodes and steps come before theirs.

    Args:
        slices: path of each piece, in order, to its split and its episodes.
    """
    pieces: list[Piece] = []
    tasks: dict[str, int] = {}
    for path, (split_name, ids) in slices.items():
        before = pieces[-1] if pieces else Piece("", ())
        texts = [known[one].instruction for one in ids]
        pieces.append(
            Piece(
                path,
                ids,
                split_name,
                len(pieces),
                before.first_episode + len(before.ids),
                before.first_step + before.steps,
                sum(known[one].steps for one in ids),
                {text: tasks.setdefault(text, len(tasks)) for text in texts},
            )
        )
    return pieces


def split(episode_ids: Sequence[str], pieces: int) -> list[list[str]]:
    """Contiguous slices whose sizes differ by at most one, so that their concatenation keeps the caller's order.

    There are ``pieces`` of them, or one per episode when there are fewer episodes than that.
    """
    count = min(pieces, len(episode_ids))
    bounds = [len(episode_ids) * k // count for k in range(count + 1)]
    return [list(episode_ids[start:stop]) for start, stop in pairwise(bounds)]


def by_suite(suites: Mapping[str, str], name: str) -> dict[str, list[str]]:
    """Set name to its episodes, in the caller's order: a set for each suite, so that clients train on one or on all.

    Args:
        suites: episode id to LIBERO suite.
        name: what the sets' names begin with; ``libero_spatial`` comes into ``<name>_spatial``.
    """
    return grouped((f"{name}_{suite.removeprefix('libero_')}", one) for one, suite in suites.items())
