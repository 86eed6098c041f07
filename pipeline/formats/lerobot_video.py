"""The video encoder that is put in lerobot's slot for a streaming encoder.

lerobot 0.4.4's own drops frames when it falls behind, and has its quality built in (33 dB with H.264).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Final

import av

from pipeline.episode_schema import SCHEMA
from pipeline.types import Frame

ENCODER: Final = "libx264"
OPTIONS = {
    # Measured on LIBERO frames (benchmarks/video_quality.py): 40 dB to the stored JPEG files in both views at 6.5 kB a
    # frame, a third of theirs, no frame below 35 dB. "superfast" saves a tenth of the bytes for twice the time.
    "preset": "ultrafast",
    "crf": "20",
    # lerobot's own choice: any frame is at most one frame away from a key frame, for random access in training.
    "g": "2",
    # The bytes depend on the number of threads; datasets are written in parallel parts already.
    "threads": "1",
}


class VideoEncoder:
    """Has the methods of ``lerobot.datasets.video_utils.StreamingVideoEncoder``; encodes each frame as it comes."""

    def __init__(self) -> None:
        self._videos: dict[str, _Video] = {}

    def start_episode(self, video_keys: Sequence[str], temp_dir: Path) -> None:
        # lerobot removes the folder of a file that it has taken over, so each file gets a folder of its own.
        self._videos = {key: _Video(Path(tempfile.mkdtemp(dir=temp_dir)) / "episode.mp4") for key in video_keys}

    def feed_frame(self, video_key: str, image: Frame) -> None:
        self._videos[video_key].add(image)

    def finish_episode(self) -> dict[str, tuple[Path, None]]:
        """Video key to its file; the place beside it is for statistics, which lerobot has from elsewhere."""
        for video in self._videos.values():
            video.finish()
        finished = {key: (video.path, None) for key, video in self._videos.items()}
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

    def finish(self) -> None:
        self._file.mux(self._stream.encode())
        self.close()

    def close(self) -> None:
        self._file.close()
