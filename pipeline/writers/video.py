"""The video encoder that is put in lerobot's slot for a streaming encoder, and exact statistics of its frames.

lerobot 0.4.4's own drops frames when it falls behind, has its quality built in (33 dB with H.264) and takes longer for
its histograms than for the video; the ``std`` it computes overflows uint8 (huggingface/lerobot#3697).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.types import Floats, Frame

ENCODER: Final = "libx264"
OPTIONS = {
    # Measured on LIBERO frames: 40 dB (agent view) and 39 dB (wrist) at 7 kB a frame, no frame below 36 dB;
    # "superfast" saves a tenth of the bytes for twice the time.
    "preset": "ultrafast",
    "crf": "20",
    # lerobot's own choice: any frame is at most one frame away from a key frame, for random access in training.
    "g": "2",
    # The bytes depend on the number of threads; datasets are written in parallel parts already.
    "threads": "1",
}
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""lerobot's names."""

LEVELS = np.arange(256.0)
Counts = NDArray[np.int64]
"""(3, 256) how often each level occurs in each channel."""


class VideoEncoder:
    """Has the methods of ``lerobot.datasets.video_utils.StreamingVideoEncoder``; encodes each frame as it comes.

    Attributes:
        counts: video key to the levels of all finished episodes.
    """

    def __init__(self) -> None:
        self.counts: dict[str, Counts] = {}
        self._videos: dict[str, _Video] = {}

    def start_episode(self, video_keys: Sequence[str], temp_dir: Path) -> None:
        # lerobot removes the folder of a file that it has taken over, so each file gets a folder of its own.
        self._videos = {key: _Video(Path(tempfile.mkdtemp(dir=temp_dir)) / "episode.mp4") for key in video_keys}

    def feed_frame(self, video_key: str, image: Frame) -> None:
        self._videos[video_key].add(image)

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, NDArray[Any]]]]:
        """Video key to its file, and to statistics in grey levels, which lerobot scales to [0, 1]."""
        finished = {}
        for key, video in self._videos.items():
            video.finish()
            self.counts[key] = self.counts.get(key, 0) + video.counts
            finished[key] = video.path, statistics(video.counts)
        self._videos = {}
        return finished

    def cancel_episode(self) -> None:
        for video in self._videos.values():
            video.close()
        self._videos = {}

    close = cancel_episode


class _Video:
    """One file in the making."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: Counts = np.zeros((3, 256), np.int64)
        self._frames = 0
        self._file = av.open(str(path), "w")
        self._stream = self._file.add_stream(ENCODER, SCHEMA.fps_hz, options=OPTIONS)
        self._stream.height, self._stream.width, _ = SCHEMA.frame.shape
        self._stream.pix_fmt = "yuv420p"

    def add(self, image: Frame) -> None:
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, SCHEMA.fps_hz)
        self._file.mux(self._stream.encode(frame))
        self._frames += 1
        for channel in range(3):
            self.counts[channel] += cv2.calcHist([image], [channel], None, [256], [0, 256])[:, 0].astype(np.int64)

    def finish(self) -> None:
        self._file.mux(self._stream.encode())
        self.close()

    def close(self) -> None:
        self._file.close()


def statistics(counts: Counts) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a video, each (3,) in grey levels, over every pixel; ``count`` is (1,), in frames."""
    height, width, _ = SCHEMA.frame.shape
    pixels = counts.sum(axis=1)
    mean = counts @ LEVELS / pixels
    quantiles: dict[str, Floats] = {
        name: np.array([np.quantile(LEVELS, q, weights=channel, method="inverted_cdf") for channel in counts])
        for name, q in QUANTILES.items()
    }
    return {
        "min": np.array([LEVELS[channel > 0].min() for channel in counts]),
        "max": np.array([LEVELS[channel > 0].max() for channel in counts]),
        "mean": mean,
        "std": np.sqrt((counts * (LEVELS - mean[:, None]) ** 2).sum(axis=1) / pixels),
        "count": pixels[:1] // (height * width),
        **quantiles,
    }
