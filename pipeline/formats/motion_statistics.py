"""Exact statistics of actions and states, over every step: the one place they are computed for every client."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.types import Floats

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
        **{name: np.quantile(exact, q, axis=0) for name, q in quantiles.items()},
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
        "action": _listed(describe(open_is_one(actions), BOUNDS)) | {"mask": mask},
        "proprio": _listed(describe(states, BOUNDS)),
        "num_transitions": len(actions),
        "num_trajectories": len(episodes),
    }


def openpi(actions: NDArray[np.float32], states: NDArray[np.float32]) -> dict[str, Any]:
    """The content of openpi's ``norm_stats.json`` for actions (N, 7), gripper as LIBERO has it, and states (N, 8)."""
    wanted = ("mean", "std", "q01", "q99")
    figures = {name: _listed(describe(values, BOUNDS)) for name, values in (("actions", actions), ("state", states))}
    return {"norm_stats": {name: {key: found[key] for key in wanted} for name, found in figures.items()}}


def _listed(figures: Mapping[str, Floats]) -> dict[str, list[float]]:
    return {name: figure.tolist() for name, figure in figures.items()}
