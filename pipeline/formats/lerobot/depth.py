"""Depth as lerobot 0.6 stores it: codes of 12 bits, logarithmic in the distance, in a lossless HEVC video.

The limits of the codes are the defaults of ``lerobot/configs/video.py`` in 0.6.1, and the codes are those of
``quantize_depth`` in ``lerobot/datasets/depth_utils.py`` there. ``meta/info.json`` states the limits, by which lerobot
decodes.

This module is light to import.
"""

from functools import cache
from math import log
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA

NEAREST_M, FURTHEST_M, SHIFT_M = 0.01, 10.0, 3.5
"""Distances of the first and the last code, and the summand of a distance in its logarithm."""

LAST_CODE = 4095

UNITS_PER_M = round(1 / SCHEMA.depth.unit_m)
"""Number of units of a depth map in a metre."""

DEPTHS = np.iinfo(SCHEMA.depth.dtype).max + 1
"""Number of depths that a map distinguishes."""

ENCODER: Final = "hevc"
PIXEL_FORMAT: Final = "gray12le"
ENCODER_OPTIONS = {
    # On LIBERO maps, 16 and 9 kB a map in agent and wrist view; "superfast" saves 40 % of the bytes for twice the time.
    "preset": "ultrafast",
    # lerobot's own choice, as for frames: any map is at most one map away from a key frame.
    "g": "2",
    "forced-idr": "1",
    # The bytes depend on the threads, and by default the file states the processor's instructions ("info"). lerobot's
    # tools cannot merge files with B-frames.
    "x265-params": "lossless=1:bframes=0:open-gop=0:info=0:pools=none:frame-threads=1:log-level=error",
}
INFO = {
    "video.codec": "hevc",
    "video.pix_fmt": PIXEL_FORMAT,
    "video.fps": SCHEMA.fps_hz,
    "has_audio": False,
    "is_depth_map": True,
    # The unit of the statistics.
    "depth_unit": "m",
    "video.depth_min": NEAREST_M,
    "video.depth_max": FURTHEST_M,
    "video.shift": SHIFT_M,
    "video.use_log": True,
    # lerobot encodes with these settings where an edit cuts a file.
    "video.g": int(ENCODER_OPTIONS["g"]),
    "video.preset": ENCODER_OPTIONS["preset"],
    "video.extra_options": {"x265-params": ENCODER_OPTIONS["x265-params"]},
}
"""Properties of these files in ``meta/info.json``, in addition to their size."""

_FIRST, _LAST = log(NEAREST_M + SHIFT_M), log(FURTHEST_M + SHIFT_M)


def codes_of(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the codes (H, W) of a depth map (H, W) in the schema's unit."""
    return np.asarray(_codes()[depth])


@cache
def _codes() -> NDArray[np.uint16]:
    """Return the code of each depth of a map, in double precision, so that all machines agree."""
    depths_m = np.arange(DEPTHS) / UNITS_PER_M
    shares = (np.log(depths_m + SHIFT_M) - _FIRST) / (_LAST - _FIRST)
    return np.rint(shares * LAST_CODE).clip(0, LAST_CODE).astype(np.uint16)


def metres_of(codes: NDArray[Any]) -> NDArray[np.float32]:
    """Return the distances that codes state, in m, as ``dequantize_depth`` of lerobot does."""
    logarithms = codes * ((_LAST - _FIRST) / LAST_CODE) + _FIRST
    return (np.exp(logarithms) - SHIFT_M).clip(NEAREST_M, FURTHEST_M).astype(np.float32)
