"""Exact statistics for every client: of actions and states over every step, of frames over every pixel.

lerobot 0.4.4 computes a camera's statistics from a sample of the frames. That takes longer than encoding an episode's
video, and its ``std`` overflows uint8 (huggingface/lerobot#3697).
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
    """Compute statistics of the columns of ``values`` (N, D), each (D,), in double precision.

    Quantiles are exact over all N rows, linearly interpolated: no histogram, and no mean of per-episode quantiles.
    """
    exact = values.astype(np.float64)
    at_quantiles = np.quantile(exact, list(quantiles.values()), axis=0)
    return {
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        "max": exact.max(axis=0),
        "min": exact.min(axis=0),
        **dict(zip(quantiles, at_quantiles, strict=True)),
    }


def open_is_one(action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert the gripper command of actions (T, 7) from LIBERO's -1 open, +1 close to 1 open, 0 close.

    OpenVLA-OFT applies this conversion (``libero_dataset_transform``) before it computes statistics and before it
    trains.
    """
    turned = action.copy()
    turned[:, -1] = 1.0 - np.clip(action[:, -1], 0.0, 1.0)
    return turned


def openvla(episodes: Sequence[Motion]) -> dict[str, Any]:
    """Compute a dataset's entry of OpenVLA-OFT's ``dataset_statistics.json``.

    The mask marks the action dimensions that OFT normalises: all but the gripper.
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
    """Compute openpi's ``norm_stats.json`` for actions (N, 7), with LIBERO's gripper command, and states (N, 8)."""
    wanted = ("mean", "std", "q01", "q99")
    norm_stats = {}
    for name, values in (("actions", actions), ("state", states)):
        figures = listed(describe(values, BOUNDS))
        norm_stats[name] = {key: figures[key] for key in wanted}
    return {"norm_stats": norm_stats}


def listed(figures: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Convert statistics to lists for JSON."""
    return {name: figure.tolist() for name, figure in figures.items()}


QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Quantiles under lerobot's names."""

Counts = NDArray[np.int64]
"""(channels, levels) number of pixels with each level in each channel; counts of several frames add up."""


def count(frame: Frame) -> Counts:
    """Count the levels of one frame (H, W, 3)."""
    channels = [cv2.calcHist([frame], [channel], None, [256], [0, 256]).ravel() for channel in range(3)]
    return np.stack(channels).astype(np.int64)


def of_levels(counts: Counts, frames: int, levels_per_unit: int = 255) -> dict[str, NDArray[Any]]:
    """Compute lerobot's statistics of a camera, each (channels, 1, 1), from the levels of a number of frames.

    ``count`` is (1,), in frames. A quantile is the least level at which the cumulative share of pixels reaches it.
    With the default of ``levels_per_unit`` the statistics are in [0, 1].
    """
    pixels, levels = counts.sum(axis=1), np.arange(float(counts.shape[1]))
    mean = counts @ levels / pixels
    shares = counts.cumsum(axis=1) / pixels[:, None]
    figures: dict[str, NDArray[Any]] = {
        "min": (counts > 0).argmax(axis=1),
        "max": (shares == 1).argmax(axis=1),
        "mean": mean,
        "std": np.sqrt((counts * (levels - mean[:, None]) ** 2).sum(axis=1) / pixels),
        **{name: (shares >= q).argmax(axis=1) for name, q in QUANTILES.items()},
    }
    scaled = {name: figure.reshape(-1, 1, 1) / levels_per_unit for name, figure in figures.items()}
    return {**scaled, "count": np.array([frames])}
