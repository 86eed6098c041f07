"""Videos of LeRobot datasets: written frame by frame, and decoded at single times."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Self

import av
import cv2
import numpy as np
from av.video.frame import PictureType
from numpy.typing import NDArray

from pipeline.episode_schema import ALL_VIEWS, SCHEMA, STANDARD, Content
from pipeline.files import Edition, edition
from pipeline.formats.lerobot import depth
from pipeline.formats.lerobot.columns import (
    ENCODER,
    ENCODER_OPTIONS,
    VIDEO_INFO,
)
from pipeline.types import Frame


class Video:
    """A file that is written frame by frame; it is complete when the block ends."""

    encoder: ClassVar[str] = ENCODER
    encoder_options: ClassVar[dict[str, str]] = ENCODER_OPTIONS
    pixel_format: ClassVar[str] = str(VIDEO_INFO["video.pix_fmt"])

    def __init__(self, path: Path, content: Content = STANDARD) -> None:
        self.frames = 0
        self._file = av.open(str(path), "w")
        self._stream = self._file.add_stream(self.encoder, SCHEMA.fps_hz, options=self.encoder_options)
        self._stream.height, self._stream.width, _ = content.frame_shape
        self._stream.pix_fmt = self.pixel_format

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        if raised[0] is None:
            self._file.mux(self._stream.encode())
        self._file.close()

    def add(self, pixels: Frame, *, first: bool) -> None:
        """Append a frame (H, W, 3).

        Args:
            pixels: the frame.
            first: True if it is the first frame of an episode.
        """
        self._append(av.VideoFrame.from_ndarray(planes(pixels), format=self.pixel_format), first)

    def _append(self, frame: av.VideoFrame, first: bool) -> None:
        frame.pts, frame.time_base = self.frames, Fraction(1, SCHEMA.fps_hz)
        if first:
            frame.pict_type = PictureType.I
        self._file.mux(self._stream.encode(frame))
        self.frames += 1


class DepthVideo(Video):
    """Depth maps in lerobot's codes, stored without loss."""

    encoder = depth.ENCODER
    encoder_options = depth.ENCODER_OPTIONS
    pixel_format = depth.PIXEL_FORMAT

    def add_map(self, values: NDArray[np.uint16], *, first: bool) -> None:
        """Append a depth map (H, W) in the schema's unit.

        Args:
            values: the map.
            first: True if it is the first map of an episode.
        """
        self._append(av.VideoFrame.from_ndarray(depth.codes_of(values), format=self.pixel_format), first)


def planes(pixels: Frame) -> NDArray[np.uint8]:
    """Convert a frame to its planes Y, U and V (3 * H / 2, W).

    The conversion takes a third of the time of FFmpeg's, at equal PSNR.
    """
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2YUV_I420), np.uint8)


def frames_at(path: Path, times_s: Sequence[float], pixel_format: str = "rgb24") -> list[NDArray[Any]]:
    """Decode the frames of a video that begin at these times.

    Raises:
        ValueError: when no frame begins at a time.
    """
    video, frames = _video(edition(path)), []
    stream = video.streams.video[0]
    for at_s in times_s:
        at = round(at_s / float(stream.time_base or 1))
        video.seek(at, stream=stream)
        from_then_on = (frame for frame in video.decode(stream) if frame.pts is not None and frame.pts >= at)
        frame = next(from_then_on, None)
        if frame is None or frame.pts != at:
            raise ValueError(f"{path.name} has no frame at {at_s:.3f} s")
        frames.append(frame.to_ndarray(format=pixel_format))
    return frames


_VIDEOS: dict[Edition, av.container.InputContainer] = {}
"""Open videos, as many as an episode may have, with those of depth."""


def _video(file: Edition) -> av.container.InputContainer:
    """Open a video and keep it open for a while, because a caller probably asks for its next frames."""
    if file not in _VIDEOS:
        while len(_VIDEOS) >= 2 * len(ALL_VIEWS):
            _VIDEOS.pop(next(iter(_VIDEOS))).close()
        _VIDEOS[file] = av.open(str(file.path))
        _VIDEOS[file].streams.video[0].thread_count = 1  # Starting more takes longer than a few frames.
    return _VIDEOS[file]
