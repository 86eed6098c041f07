"""One episode wherever it lies, which the checks look at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.episode_schema import MOTION
from pipeline.formats.read_back import Copy, Fault, sampled
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Frame, Trajectory


@dataclass(frozen=True)
class Case:
    """One episode and everything known of it.

    Attributes:
        made: as the episode store has it.
        trajectory: the replay that it was rendered from.
        copies: as each dataset has it, as far as it could be read.
        bank: the run's own bank of rewrites.
    """

    row: Mapping[str, Any]
    made: Episode
    trajectory: Trajectory
    copies: Sequence[Copy]
    bank: Path | None

    @cached_property
    def shown(self) -> dict[int, dict[str, Frame]]:
        """Sampled step to what the store has in every view there."""
        return {
            step: {view: decode(frames[step]) for view, frames in self.made.frames.items()}
            for step in sampled(len(self.made))
        }

    @property
    def whole(self) -> list[Copy]:
        """The copies of the right shapes: what else is wrong with the others follows from that."""
        return [
            copy
            for copy in self.copies
            if all(getattr(copy.episode, name).shape == getattr(self.made, name).shape for name in MOTION)
        ]

    def finding(self, dataset: str, what: str, expected: object) -> Fault:
        return Fault(dataset, self.made.episode_id, what, str(expected))
