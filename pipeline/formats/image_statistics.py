"""Exact statistics of frames, over every pixel: how often each level occurs in each channel.

lerobot 0.4.4 takes longer for its own than for a whole episode's video, from a sample of the frames, and the ``std``
among them overflows uint8 (huggingface/lerobot#3697).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.types import Floats, Frame

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""lerobot's names."""

Counts = NDArray[np.int64]
"""(3, 256) how often each level occurs in each channel; counts of several frames add up."""

_LEVELS = np.arange(256.0)


def count(frame: Frame) -> Counts:
    """The levels of one frame (H, W, 3)."""
    channels = [cv2.calcHist([frame], [channel], None, [256], [0, 256])[:, 0] for channel in range(3)]
    return np.stack(channels).astype(np.int64)


def statistics(counts: Counts) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a camera, each (3, 1, 1) in [0, 1] as it hands out frames; ``count`` is (1,), in frames.

    Quantiles are the least level that the share of pixels does not exceed.
    """
    height, width, _ = SCHEMA.frame.shape
    pixels = counts.sum(axis=1)
    mean = counts @ _LEVELS / pixels
    found: dict[str, Floats] = {
        "min": np.array([_LEVELS[channel > 0].min() for channel in counts]),
        "max": np.array([_LEVELS[channel > 0].max() for channel in counts]),
        "mean": mean,
        "std": np.sqrt((counts * (_LEVELS - mean[:, None]) ** 2).sum(axis=1) / pixels),
    }
    for name, q in QUANTILES.items():
        found[name] = np.array([np.quantile(_LEVELS, q, weights=channel, method="inverted_cdf") for channel in counts])
    scaled = {name: levels.reshape(3, 1, 1) / 255 for name, levels in found.items()}
    return {**scaled, "count": pixels[:1] // (height * width)}
