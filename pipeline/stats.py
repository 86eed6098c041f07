"""Dataset statistics as OpenVLA-OFT computes and names them, exact over every step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA


def openvla(episodes: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> dict[str, Any]:
    """Statistics of ``(action (T, 7), state (T, 8))`` pairs for OFT's ``dataset_statistics.json``.

    As OFT's ``libero_dataset_transform`` does before it measures, the gripper command is turned from LIBERO's -1 open,
    +1 close into 1 open, 0 close. The mask says which action dimensions OFT normalises: all but the gripper.
    """
    actions, states = (np.concatenate(column) for column in zip(*episodes, strict=True))
    actions = actions.copy()
    actions[:, -1] = 1.0 - np.clip(actions[:, -1], 0.0, 1.0)
    mask = [not name.startswith("gripper") for name in SCHEMA.action.names]
    return {
        "action": _describe(actions) | {"mask": mask},
        "proprio": _describe(states),
        "num_transitions": len(actions),
        "num_trajectories": len(episodes),
    }


def _describe(values: NDArray[np.float32]) -> dict[str, list[float]]:
    exact = values.astype(np.float64)
    figures = {
        "mean": exact.mean(0),
        "std": exact.std(0),
        "max": exact.max(0),
        "min": exact.min(0),
        "q01": np.quantile(exact, 0.01, axis=0),
        "q99": np.quantile(exact, 0.99, axis=0),
    }
    return {name: figure.tolist() for name, figure in figures.items()}
