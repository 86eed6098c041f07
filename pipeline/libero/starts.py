"""Start of a recording with the controller's and the gripper's targets, and the recording's no-ops."""

import numpy as np
from numpy.typing import NDArray

from pipeline.types import Demo, Floats, Scene, Start

HOME_RAD = np.array([0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4])
"""Joint angles (7,) of the arm after LIBERO's reset, before noise."""

SCATTER_RAD = 0.16
"""Largest distance of LIBERO's starts from home.

The largest distance is 0.154 in the 130 starter demonstrations, and 0.100 in the 2,000 initial states of the four
suites' evaluations.
"""

LEFT_OUT_STEPS = 5
"""Control steps after a reset that LIBERO removes from a recording (``cap_index`` of its ``create_dataset.py``)."""

SETTLING_STEPS = 10
"""Number of control steps before the first observation, in which objects settle (OpenVLA's and LIBERO-Plus's rule)."""

NOOP_NORM = 1e-4
"""Largest norm of the six pose deltas that still counts as no motion (OpenVLA's `regenerate_libero_dataset.py`)."""


def recorded_start(demo: Demo, model_xml: str, settles: bool = True) -> Scene:
    """Return the scene that a demonstration starts in.

    The gripper has the command of the first action: it reached this command in the steps that LIBERO removes from a
    recording. The controller has the reset's posture if the scene settles, as in an evaluation, which sets a state
    after a reset. Otherwise the controller holds the arm at its place. This also applies to starts too far from home
    for a reset, such as most demonstrations of ``demos expand --starts wide``.
    """
    # A flattened state has the time, then the arm's seven joints.
    near = float(np.linalg.norm(demo.init_state[1:8] - HOME_RAD)) <= SCATTER_RAD
    start = Start(
        gripper=1.0 if demo.actions[0, 6] > 0 else -1.0,
        posture_rad=tuple(HOME_RAD.tolist()) if settles and near else None,
    )
    return Scene(model_xml, demo.init_state, start=start)


def kept_actions(actions: Floats, noops: str) -> NDArray[np.bool_]:
    """Return a mask (T,) of the actions (T, 7) that are executed; replay skips the others without a physics step.

    A no-op moves the arm by less than ``NOOP_NORM`` and has the gripper's command of the last executed action. The
    very first action is a no-op by its motion alone. This is OpenVLA's rule.

    Args:
        actions: (T, 7) pose deltas and gripper.
        noops: ``drop``, ``trim_ends`` or ``keep``.
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
