"""Which actions of a demonstration do nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.types import Floats

NOOP_NORM = 1e-4
"""Largest norm of the six pose deltas that still counts as no motion (OpenVLA's `regenerate_libero_dataset.py`)."""


def kept_actions(actions: Floats, noops: str) -> NDArray[np.bool_]:
    """(T,) which of the actions (T, 7) are executed; the others are skipped without stepping the physics.

    A no-op moves the arm by less than ``NOOP_NORM`` and leaves the gripper as the last executed action had it
    (OpenVLA's rule; the very first action is a no-op by its motion alone). ``noops`` is ``drop``, ``trim_ends`` or
    ``keep``.
    """
    if noops == "keep":
        return np.ones(len(actions), bool)
    still = np.linalg.norm(actions[:, :6], axis=1) < NOOP_NORM
    real = np.zeros(len(actions), bool)
    gripper: float | None = None
    for step, action in enumerate(actions):
        real[step] = not (still[step] and (gripper is None or action[6] == gripper))
        if real[step]:
            gripper = action[6]
    if noops == "trim_ends" and real.any():
        first, last = np.flatnonzero(real)[[0, -1]]
        real[first : last + 1] = True
    return real
