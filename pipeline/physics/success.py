"""Verdicts on replays, each with its reason."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.types import Floats, Verdict

KEPT = Verdict(True, "kept")


def verdict(states: Floats, succeeded: NDArray[np.bool_]) -> Verdict:
    """Judge a replay: the task's goal must hold after the last executed action.

    Args:
        states: (K+1, S) states before each executed action and after the last.
        succeeded: (K,) LIBERO's success check after each executed action.
    """
    if len(succeeded) < SCHEMA.min_steps:
        return Verdict(False, "too_short")
    if not np.isfinite(states).all():
        return Verdict(False, "simulation_unstable")
    if succeeded[-1]:
        return KEPT
    return Verdict(False, "goal_lost" if succeeded.any() else "goal_not_reached")
