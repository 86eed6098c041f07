"""Frames as a short H.264 video that every browser plays, small enough to be part of a page."""

import io
from collections.abc import Sequence
from fractions import Fraction

import av

from pipeline.episode_schema import SCHEMA
from pipeline.types import Frame

VIDEO_BYTES = 300_000
"""At most this large."""

_ENCODER, _CRF = "libx264", "26"


def mp4(frames: Sequence[Frame], steps: Sequence[int]) -> bytes:
    """A video in real time, of at most ``VIDEO_BYTES``.

    Args:
        frames: (H, W, 3) each, H and W even.
        steps: the control step, 50 ms, from which each frame is shown until the next one; increasing.
    """
    # A buffer of one second begins full, so that a video may have a second's bytes above its rate; a twentieth is left
    # for the container. One thread, as the bytes depend on their number.
    shown_s = (steps[-1] - steps[0] + 1) / SCHEMA.fps_hz
    bits_per_s = int(0.95 * VIDEO_BYTES * 8 / (shown_s + 1))
    rate = {"maxrate": str(bits_per_s), "bufsize": str(bits_per_s)}
    limits = {"crf": _CRF, "preset": "veryfast", "threads": "1", **rate}
    packed = io.BytesIO()
    with av.open(packed, "w", format="mp4") as file:
        stream = file.add_stream(_ENCODER, SCHEMA.fps_hz, options=limits)
        stream.height, stream.width, _ = frames[0].shape
        stream.pix_fmt = "yuv420p"
        for shown, step in zip(frames, steps, strict=True):
            frame = av.VideoFrame.from_ndarray(shown, format="rgb24")
            frame.pts, frame.time_base = step - steps[0], Fraction(1, SCHEMA.fps_hz)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return packed.getvalue()
