"""What is found where a dataset is read back: its copies of episodes, its files, and what is off with either."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pipeline.errors import MAKE_AGAIN
from pipeline.files import checksum
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Frame


@dataclass(frozen=True)
class Fault:
    """Something off.

    Attributes:
        dataset: a format's name, ``manifest``, or ``frames`` for the store that the datasets were made from.
        episode: its id, or None when it is about the whole dataset.
    """

    dataset: str
    episode: str | None
    what: str
    expected: str


@dataclass(frozen=True)
class Statistics:
    """What a dataset states of an episode's columns, and the columns.

    Attributes:
        stored: column to the name of a figure to its values.
        numbers: column to what it has at each step, (T, D).
        views: view to the column of its frames.
        quantiles: names of the quantiles that are stated of an episode.
    """

    stored: Mapping[str, Mapping[str, Any]]
    numbers: Mapping[str, NDArray[Any]]
    views: Mapping[str, str]
    quantiles: Sequence[str] = ()


@dataclass(frozen=True)
class Copy:
    """An episode as a dataset hands it out.

    Attributes:
        episode: the record that its writer was given, as far as the dataset has it: of whatever shapes and types stand
            there, with the instruction of the first step, and without frames where they are no image files.
        instructions: one for each step.
        decoded: (view, step) to the frame, for ``sampled`` steps, where frames are a video.
        marks: what else stands at each step, by the dataset's own names, each (T,).
        place: where it lies, by the format's columns of the manifest.
        said: lerobot's language column, the entries of each step; None where the dataset has none.
        train: whether it is there to train on.
        statistics: those of the episode; None where the dataset states none.
    """

    dataset: str
    episode: Episode
    instructions: Sequence[str]
    decoded: Mapping[tuple[str, int], Frame]
    marks: Mapping[str, NDArray[Any]]
    place: Mapping[str, Any]
    said: Sequence[Sequence[Mapping[str, Any]]] | None = None
    train: bool = True
    statistics: Statistics | None = None

    def __len__(self) -> int:
        return len(self.episode)

    def frame(self, view: str, step: int) -> Frame:
        """(H, W, 3) of a sampled step.

        Raises:
            ValueError: when it cannot be decoded.
        """
        files = self.episode.frames.get(view)
        return decode(files[step]) if files else self.decoded[view, step]


@dataclass(frozen=True)
class Written:
    """A file as the record of its dataset has it.

    Attributes:
        sha256: of what was written.
    """

    dataset: str
    file: Path
    sha256: str

    def faults(self) -> list[Fault]:
        """What is off with it, by reading all of it: nothing, or that it is not what was written."""
        expected = f"what its checksum in {self.dataset}.json is of; move it away, and `{MAKE_AGAIN}` makes it again"
        try:
            same = checksum(self.file) == self.sha256
        except OSError as error:
            return [Fault(self.dataset, None, f"{self.file}: cannot be read ({error})", expected)]
        return [] if same else [Fault(self.dataset, None, f"{self.file}: was changed since it was written", expected)]


def in_both_splits(
    dataset: str, split_of: Mapping[str, str], kept: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, Fault]]:
    """Find demonstrations with episodes in two splits: validation would know the actions from training.

    All that was expanded from one human demonstration counts as that one.

    Args:
        split_of: episode id to its split.
        kept: episode id to its row of the manifest.
    """
    first: dict[tuple[str, str], str] = {}
    for episode_id, split in split_of.items():
        if (row := kept.get(episode_id)) is None:
            continue  # Reported as a foreign one.
        task = row["demo_id"].rpartition("/")[0]
        origin = (task, row.get("demo_origin_sha256") or row["demo_id"])
        other = split_of[first.setdefault(origin, episode_id)]
        if other != split:
            what = f"is in {split}, and {first[origin]} of the same demonstration {row['demo_id']} in {other}"
            yield "splits", Fault(dataset, episode_id, what, "one split for all episodes of a demonstration")


def unlike(dataset: str, read: Mapping[str, Any], wanted: Mapping[str, Any], within: str = "") -> Iterator[Fault]:
    """Compare what files state, by the name of the statement, with what they should state."""
    for name, expected in wanted.items():
        if read.get(name) != expected:
            yield Fault(dataset, None, f"{within}{name} is {_short(read.get(name))}", _short(expected))


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 200 else f"{text[:200]}…"


def sampled(steps: int) -> list[int]:
    """The steps whose frames are decoded: the first, the middle and the last."""
    return sorted({0, steps // 2, steps - 1})
