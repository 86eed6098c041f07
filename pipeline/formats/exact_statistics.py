"""Exact statistics for every client: of actions and states over every step, of frames over every pixel.

lerobot 0.4.4 takes longer for a camera's, from a sample of the frames, than for a whole episode's video, and the
``std`` among them overflows uint8 (huggingface/lerobot#3697).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.types import Floats, Frame

BOUNDS = {"q01": 0.01, "q99": 0.99}

Motion = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Action (T, 7) and state (T, 8) of one episode, as they are stored."""


def describe(values: NDArray[Any], quantiles: Mapping[str, float]) -> dict[str, Floats]:
    """Statistics of the columns of ``values`` (N, D), each (D,), in double precision.

    Quantiles are those of all N rows, linearly interpolated: no histogram, and no mean of per-episode quantiles.
    """
    exact = values.astype(np.float64)
    return {
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        "max": exact.max(axis=0),
        "min": exact.min(axis=0),
        **dict(zip(quantiles, np.quantile(exact, list(quantiles.values()), axis=0), strict=True)),
    }


def open_is_one(action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Actions (T, 7) with the gripper command turned from LIBERO's -1 open, +1 close into 1 open, 0 close.

    This is OpenVLA-OFT's ``libero_dataset_transform``, which comes before it measures and before it trains.
    """
    turned = action.copy()
    turned[:, -1] = 1.0 - np.clip(action[:, -1], 0.0, 1.0)
    return turned


def openvla(episodes: Sequence[Motion]) -> dict[str, Any]:
    """One dataset's entry of OpenVLA-OFT's ``dataset_statistics.json``.

    The mask says which action dimensions OFT normalises: all but the gripper.
    """
    actions, states = (np.concatenate(column) for column in zip(*episodes, strict=True))
    mask = [not name.startswith("gripper") for name in SCHEMA.action.names]
    return {
        "action": listed(describe(open_is_one(actions), BOUNDS)) | {"mask": mask},
        "proprio": listed(describe(states, BOUNDS)),
        "num_transitions": len(actions),
        "num_trajectories": len(episodes),
    }


def openpi(actions: NDArray[np.float32], states: NDArray[np.float32]) -> dict[str, Any]:
    """The content of openpi's ``norm_stats.json`` for actions (N, 7), gripper as LIBERO has it, and states (N, 8)."""
    wanted = ("mean", "std", "q01", "q99")
    figures = {name: listed(describe(values, BOUNDS)) for name, values in (("actions", actions), ("state", states))}
    return {"norm_stats": {name: {key: found[key] for key in wanted} for name, found in figures.items()}}


def listed(figures: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Statistics by name, as JSON has them."""
    return {name: figure.tolist() for name, figure in figures.items()}


QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""lerobot's names."""

Counts = NDArray[np.int64]
"""(3, 256) how often each level occurs in each channel; counts of several frames add up."""

_LEVELS = np.arange(256.0)


def count(frame: Frame) -> Counts:
    """The levels of one frame (H, W, 3)."""
    channels = [cv2.calcHist([frame], [channel], None, [256], [0, 256]).ravel() for channel in range(3)]
    return np.stack(channels).astype(np.int64)


def of_levels(counts: Counts) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a camera, each (3, 1, 1) in [0, 1] as it hands out frames; ``count`` is (1,), in frames.

    Quantiles are the least level that the share of pixels does not exceed.
    """
    height, width, _ = SCHEMA.frame.shape
    pixels = counts.sum(axis=1)
    mean = counts @ _LEVELS / pixels
    shares = counts.cumsum(axis=1) / pixels[:, None]
    found: dict[str, NDArray[Any]] = {
        "min": (counts > 0).argmax(axis=1),
        "max": (shares == 1).argmax(axis=1),
        "mean": mean,
        "std": np.sqrt((counts * (_LEVELS - mean[:, None]) ** 2).sum(axis=1) / pixels),
        **{name: (shares >= q).argmax(axis=1) for name, q in QUANTILES.items()},
    }
    scaled = {name: levels.reshape(3, 1, 1) / 255 for name, levels in found.items()}
    return {**scaled, "count": pixels[:1] // (height * width)}
