"""What is found where a dataset is read back: its copies of episodes, its files, and what is off with either."""

from collections.abc import Mapping, Sequence
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
    """

    dataset: str
    episode: Episode
    instructions: Sequence[str]
    decoded: Mapping[tuple[str, int], Frame]
    marks: Mapping[str, NDArray[Any]]
    place: Mapping[str, Any]
    said: Sequence[Sequence[Mapping[str, Any]]] | None = None
    train: bool = True

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
        expected = f"what its checksum in {self.dataset}.json is of; delete it, and `{MAKE_AGAIN}` makes it again"
        try:
            same = checksum(self.file) == self.sha256
        except OSError as error:
            return [Fault(self.dataset, None, f"{self.file}: cannot be read ({error})", expected)]
        return [] if same else [Fault(self.dataset, None, f"{self.file}: was changed since it was written", expected)]


def sampled(steps: int) -> list[int]:
    """The steps whose frames are decoded: the first, the middle and the last."""
    return sorted({0, steps // 2, steps - 1})
