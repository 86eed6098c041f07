"""One episode wherever it lies, which the checks look at."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import MOTION
from pipeline.formats.read_back import Copy, Fault, sampled
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Frame, Trajectory


@dataclass(frozen=True)
class Seen:
    """A view of an episode.

    Attributes:
        frames: sampled step to its frame, (H, W, 3).
        video: whether they are of a video.
    """

    dataset: str
    view: str
    frames: Mapping[int, Frame]
    video: bool = False

    @cached_property
    def grey(self) -> dict[int, NDArray[np.uint8]]:
        """The same frames, (H, W) each."""
        return {
            step: np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8) for step, frame in self.frames.items()
        }


@dataclass(frozen=True)
class Case:
    """One episode and everything known of it.

    Attributes:
        made: as the episode store has it.
        trajectory: the replay that it was rendered from.
        copies: as each dataset has it, as far as it could be read.
        bank: the run's own bank of rewrites.
        witness: whether it is one of the few of which all frames are decoded.
    """

    row: Mapping[str, Any]
    made: Episode
    trajectory: Trajectory
    copies: Sequence[Copy]
    bank: Path | None
    witness: bool = False

    @cached_property
    def levels(self) -> dict[str, NDArray[np.int64]]:
        """View to how often each level occurs in each channel of all of its stored frames, (3, 256)."""
        return {view: _levels(map(decode, files)) for view, files in self.made.frames.items()}

    @cached_property
    def sampled_levels(self) -> dict[str, NDArray[np.int64]]:
        """View to the same of its sampled frames."""
        return {view: _levels(seen.frames.values()) for view, seen in self.stored.items()}

    @cached_property
    def stored(self) -> dict[str, Seen]:
        """View to what the store shows there."""
        steps = sampled(len(self.made))
        return {
            view: Seen("frames", view, {step: decode(files[step]) for step in steps})
            for view, files in self.made.frames.items()
        }

    @cached_property
    def seen(self) -> list[Seen]:
        """The views of the store, and those of the copies that are not the very files of the store."""
        found = [*self.stored.values()]
        for copy in self.whole:
            for view, stored in self.stored.items():
                files = copy.episode.frames.get(view)
                if files and all(files[step] == self.made.frames[view][step] for step in stored.frames):
                    continue
                # Of what cannot be decoded, ``jpeg`` tells, and ``format`` where a view is not there.
                with suppress(ValueError, TypeError, LookupError, cv2.error):
                    frames = {step: copy.frame(view, step) for step in stored.frames}
                    found.append(Seen(copy.dataset, view, frames, video=not files))
        return found

    @cached_property
    def whole(self) -> list[Copy]:
        """The copies of the right shapes: what else is wrong with the others follows from that."""
        return [
            copy
            for copy in self.copies
            if all(getattr(copy.episode, name).shape == getattr(self.made, name).shape for name in MOTION)
        ]

    def finding(self, dataset: str, what: str, expected: object) -> Fault:
        return Fault(dataset, self.made.episode_id, what, str(expected))


def _levels(frames: Iterable[Frame]) -> NDArray[np.int64]:
    counts = np.zeros((3, 256), np.int64)
    for frame in frames:
        counts += [np.bincount(frame[..., channel].ravel(), minlength=256) for channel in range(3)]
    return counts
