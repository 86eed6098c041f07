"""Records of a dataset that is read back: its copies of episodes, its files, and the faults of both."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import MAKE_AGAIN
from pipeline.files import checksum
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Frame, Subtask


@dataclass(frozen=True)
class Fault:
    """A difference between a dataset and its expected content.

    Attributes:
        dataset: a format's name, ``manifest``, or ``frames`` for the store behind the datasets.
        episode: id of the episode, or ``None`` when the fault concerns the whole dataset.
        what: the statement or content of the dataset.
        expected: the expected statement or content.
    """

    dataset: str
    episode: str | None
    what: str
    expected: str


@dataclass(frozen=True)
class Statistics:
    """Statistics that a dataset states of an episode's columns, and the columns.

    Attributes:
        stored: column to the name of a statistic to its values.
        numbers: column to its values at each step, (T, D).
        views: view to the column of its frames.
        depth: view to the column of its depth, if that is a video.
        quantiles: names of the quantiles that the dataset states of an episode.
    """

    stored: Mapping[str, Mapping[str, Any]]
    numbers: Mapping[str, NDArray[Any]]
    views: Mapping[str, str]
    quantiles: Sequence[str] = ()
    depth: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Copy:
    """An episode as a dataset returns it.

    Attributes:
        dataset: name of the format.
        episode: the writer's record as far as the dataset stores it. It has the shapes and types of the dataset, the
            instruction of the first step, and frames only if they are image files.
        instructions: one for each step.
        decoded: (view, step) to the frame, for ``sampled`` steps, where frames are a video.
        step_marks: further columns of each step, by the dataset's own names, each (T,).
        place: place of the episode, by the format's columns of the manifest.
        repeated: further name of a column of the provenance, to that column and the value under the further name.
        persistent_language: lerobot's column of persistent language, the entries of each step; ``None`` where the
            dataset has none.
        events: lerobot's column of language events, likewise.
        train: True if the episode is in the training split.
        statistics: statistics of the episode; ``None`` where the dataset states none.
        lossless_frames: function that yields the frames (H, W, 3) of a view at all steps, one at a time, if they are
            stored without loss; else ``None``. It raises a PipelineError if a frame cannot be read.
        depth_m: (view, step) to the depth (H, W) in m, for ``sampled`` steps, where depth is a video.
    """

    dataset: str
    episode: Episode
    instructions: Sequence[str]
    decoded: Mapping[tuple[str, int], Frame]
    step_marks: Mapping[str, NDArray[Any]]
    place: Mapping[str, Any]
    persistent_language: Sequence[Sequence[Mapping[str, Any]]] | None = None
    events: Sequence[Sequence[Mapping[str, Any]]] | None = None
    train: bool = True
    statistics: Statistics | None = None
    lossless_frames: Callable[[str], Iterator[Frame]] | None = None
    depth_m: Mapping[tuple[str, int], NDArray[np.float32]] = field(default_factory=dict)
    repeated: Mapping[str, tuple[str, Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.episode)

    def frame(self, view: str, step: int) -> Frame:
        """Return the frame (H, W, 3) of a sampled step.

        Raises:
            ValueError: when the frame cannot be decoded.
        """
        files = self.episode.frames.get(view)
        return decode(files[step]) if files else self.decoded[view, step]


@dataclass(frozen=True)
class Written:
    """A file as the record of its dataset states it.

    Attributes:
        sha256: SHA-256 of the written content.
    """

    dataset: str
    file: Path
    sha256: str

    def faults(self) -> list[Fault]:
        """Read the whole file and report if it is unreadable or differs from the written content."""
        remedy = f"move the file away, and `{MAKE_AGAIN}` writes it again"
        expected = f"the content with its checksum in {self.dataset}.json; {remedy}"
        try:
            same = checksum(self.file) == self.sha256
        except OSError as error:
            return [Fault(self.dataset, None, f"{self.file}: cannot be read ({error})", expected)]
        return [] if same else [Fault(self.dataset, None, f"{self.file}: has changed since it was written", expected)]


def subtasks_of(starts: Sequence[int], texts: Sequence[str]) -> tuple[Subtask, ...]:
    """Join the two lists of an episode's subtasks.

    Raises:
        ValueError: when they differ in length.
    """
    return tuple(Subtask(int(start), str(text)) for start, text in zip(starts, texts, strict=True))


def too_many_episodes(dataset: str, stored: int, kept: int) -> Iterator[tuple[str, Fault]]:
    """Find a dataset with more episodes than the kept ones. Reading the episodes reports missing ones.

    Args:
        dataset: name of the format.
        stored: number of episodes in the dataset.
        kept: number of kept episodes.
    """
    if stored > kept:
        yield "ids", Fault(dataset, None, f"has {stored} episodes, of which some are foreign or repeated", f"{kept}")


def wrong_splits(
    dataset: str, names: set[str], validation: float, statement: str = "the splits are"
) -> Iterator[tuple[str, Fault]]:
    """Compare the names of a dataset's splits with ``train`` and, with a validation share above 0, ``val``.

    Args:
        dataset: name of the format.
        names: names of the splits.
        validation: share of the demonstrations in ``val``.
        statement: start of the fault's text, before the names.
    """
    wanted = {"train", "val"} if validation else {"train"}
    if names != wanted:
        yield "format", Fault(dataset, None, f"{statement} {sorted(names)}", f"{sorted(wanted)}")


def in_both_splits(
    dataset: str, split_of: Mapping[str, str], kept: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, Fault]]:
    """Find demonstrations with episodes in two splits: training would contain the actions of validation.

    Demonstrations that were expanded from one human demonstration count as one.

    Args:
        dataset: name of the format.
        split_of: episode id to its split.
        kept: episode id to its row of the manifest.
    """
    first: dict[tuple[str, str], str] = {}
    for episode_id, split in split_of.items():
        row = kept.get(episode_id)
        if row is None:
            continue  # Another check reports it as an unexpected episode.
        task = row["demo_id"].rpartition("/")[0]
        origin = (task, row.get("demo_origin_sha256") or row["demo_id"])
        first_split = split_of[first.setdefault(origin, episode_id)]
        if first_split != split:
            what = f"is in {split}, and {first[origin]} of the same demonstration {row['demo_id']} in {first_split}"
            yield "splits", Fault(dataset, episode_id, what, "one split for all episodes of a demonstration")


def unlike(dataset: str, read: Mapping[str, Any], wanted: Mapping[str, Any], within: str = "") -> Iterator[Fault]:
    """Compare the statements of files with the expected statements, both by name."""
    for name, expected in wanted.items():
        if read.get(name) != expected:
            yield Fault(dataset, None, f"{within}{name} is {_short(read.get(name))}", _short(expected))


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 200 else f"{text[:200]}…"


def sampled(steps: int) -> list[int]:
    """Return the steps whose frames are decoded: the first, the middle and the last."""
    return sorted({0, steps // 2, steps - 1})
