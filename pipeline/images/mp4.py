"""Frames as a short H.264 video that every browser plays, small enough to be part of a page."""

import io
from collections.abc import Sequence
from fractions import Fraction

import av

from pipeline.episode_schema import SCHEMA
from pipeline.types import Frame

VIDEO_BYTES = 300_000
"""Largest size of a video."""

_ENCODER, _CRF = "libx264", "26"


def mp4(frames: Sequence[Frame], steps: Sequence[int]) -> bytes:
    """Encode frames as a video in real time, of at most ``VIDEO_BYTES``.

    Args:
        frames: (H, W, 3) each, H and W even.
        steps: the control step (50 ms) from which each frame is shown until the next frame; increasing.
    """
    # The encoder's buffer holds one second and begins full, so a video may exceed its rate by one second's bytes.
    # A twentieth of the bytes is left for the container. The bytes depend on the number of threads, so there is one.
    shown_s = (steps[-1] - steps[0] + 1) / SCHEMA.fps_hz
    bits_per_s = int(0.95 * VIDEO_BYTES * 8 / (shown_s + 1))
    rate = {"maxrate": str(bits_per_s), "bufsize": str(bits_per_s)}
    limits = {"crf": _CRF, "preset": "veryfast", "threads": "1", **rate}
    packed = io.BytesIO()
    with av.open(packed, "w", format="mp4") as file:
        stream = file.add_stream(_ENCODER, SCHEMA.fps_hz, options=limits)
        stream.height, stream.width, _ = frames[0].shape
        stream.pix_fmt = "yuv420p"
        for pixels, step in zip(frames, steps, strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = step - steps[0], Fraction(1, SCHEMA.fps_hz)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return packed.getvalue()
