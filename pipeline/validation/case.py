"""Data of one episode from the run's stores and from its datasets, which the checks compare."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import task_of
from pipeline.episode_schema import MOTION, SCHEMA
from pipeline.formats.read_back import Copy, Fault, sampled
from pipeline.images.jpeg import decode, decode_exactly
from pipeline.types import Episode, Frame, Task, Trajectory


@dataclass(frozen=True)
class ShownView:
    """Sampled frames of a view of an episode, in the store or in a dataset.

    Attributes:
        frames: sampled step to its frame, (H, W, 3).
        video: True if the frames were decoded from a video.
    """

    dataset: str
    view: str
    frames: Mapping[int, Frame]
    video: bool = False

    @cached_property
    def grey(self) -> dict[int, NDArray[np.uint8]]:
        """Frames in grey, (H, W) each."""
        grey = {}
        for step, frame in self.frames.items():
            grey[step] = np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)
        return grey


@dataclass(frozen=True)
class Case:
    """An episode in all places that store it.

    Attributes:
        row: its row of the manifest.
        episode: the episode in the run's stores.
        trajectory: the replay that it was rendered from.
        copies: the episode in each dataset from which it could be read.
        bank: the run's own bank of rewrites.
        decodes_all_frames: True if all frames of the episode are decoded, which is done for a few episodes only.
    """

    row: Mapping[str, Any]
    episode: Episode
    trajectory: Trajectory
    copies: Sequence[Copy]
    bank: Path | None
    decodes_all_frames: bool = False

    @cached_property
    def task(self) -> Task:
        """Task that the episode carries out."""
        return task_of(self.row["suite"], self.row["task"], self.row["perturbations"])

    @cached_property
    def levels(self) -> dict[str, NDArray[np.int64]]:
        """Histogram of levels in each channel of all stored frames, (3, 256), by view."""
        return {view: _levels(map(decode, files)) for view, files in self.episode.frames.items()}

    @cached_property
    def sampled_levels(self) -> dict[str, NDArray[np.int64]]:
        """Histogram of levels in each channel of the sampled frames, (3, 256), by view."""
        return {view: _levels(shown_view.frames.values()) for view, shown_view in self.sampled_views.items()}

    @cached_property
    def sampled_views(self) -> dict[str, ShownView]:
        """Sampled frames of the store, by view."""
        steps = sampled(len(self.episode))
        views = {}
        for view, files in self.episode.frames.items():
            frames = {step: decode(files[step]) for step in steps}
            views[view] = ShownView("frames", view, frames)
        return views

    @cached_property
    def sampled_depth_m(self) -> dict[tuple[str, int], NDArray[np.float64]]:
        """Stored depth (H, W) in m of the sampled steps, by view and step; empty where no depth is stored."""
        depth_m = {}
        for view, geometry in self.episode.geometry.items():
            files = geometry.maps.get("depth", ())
            for step in sampled(len(files)) if files else ():
                depth_m[view, step] = decode_exactly(files[step]) * SCHEMA.depth.unit_m
        return depth_m

    def depth_m(self, view: str) -> NDArray[np.float64]:
        """Return the stored depth of all steps of a view in m, (T, H, W)."""
        files = self.episode.geometry[view].maps["depth"]
        return np.stack([decode_exactly(file) for file in files]) * SCHEMA.depth.unit_m

    @cached_property
    def shown_views(self) -> list[ShownView]:
        """Views of the store, and views of the copies whose files differ from the store's."""
        views = [*self.sampled_views.values()]
        for copy in self.comparable_copies:
            for view, stored in self.sampled_views.items():
                files = copy.episode.frames.get(view)
                if files and all(files[step] == self.episode.frames[view][step] for step in stored.frames):
                    continue
                # ``jpeg`` reports files that cannot be decoded, and ``format`` reports missing views.
                with suppress(ValueError, TypeError, LookupError, cv2.error):
                    frames = {step: copy.frame(view, step) for step in stored.frames}
                    views.append(ShownView(copy.dataset, view, frames, video=not files))
        return views

    @cached_property
    def comparable_copies(self) -> list[Copy]:
        """Copies with the right shapes. A copy with a wrong shape would fail most checks for that reason alone."""
        return [copy for copy in self.copies if _same_shapes(copy.episode, self.episode)]

    def finding(self, dataset: str, what: str, expected: object) -> Fault:
        return Fault(dataset, self.episode.episode_id, what, str(expected))


def _same_shapes(copy: Episode, stored: Episode) -> bool:
    return all(getattr(copy, name).shape == getattr(stored, name).shape for name in MOTION)


def _levels(frames: Iterable[Frame]) -> NDArray[np.int64]:
    counts = np.zeros((3, 256), np.int64)
    for frame in frames:
        counts += [np.bincount(frame[..., channel].ravel(), minlength=256) for channel in range(3)]
    return counts


def same_bits(first: NDArray[Any] | None, second: NDArray[Any] | None) -> bool:
    """Compare two arrays bit for bit, with shape and type; `None` equals only `None`."""
    if first is None or second is None:
        return first is second
    return (first.shape, first.dtype, first.tobytes()) == (second.shape, second.dtype, second.tobytes())
