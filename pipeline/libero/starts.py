"""Where a recording starts, what the robot's controller and gripper were at then, and which actions do nothing."""

import numpy as np
from numpy.typing import NDArray

from pipeline.types import Demo, Floats, Scene

HOME_RAD = np.array([0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4])
"""(7,) where LIBERO's reset puts the arm, before noise."""

SCATTER_RAD = 0.16
"""No start of LIBERO's is further from home: at most 0.154 in the 130 starter demonstrations, 0.100 in the 2,000
initial states that the four suites are evaluated from."""

LEFT_OUT_STEPS = 5
"""Control steps after a reset that LIBERO cuts off a recording (``cap_index`` of its ``create_dataset.py``)."""

NOOP_NORM = 1e-4
"""Largest norm of the six pose deltas that still counts as no motion (OpenVLA's `regenerate_libero_dataset.py`)."""


def recorded_start(demo: Demo, model_xml: str, settles: bool = True) -> Scene:
    """Where a demonstration starts.

    In the steps that LIBERO cuts off a recording, the gripper's command came to what the first action that is left
    asks for. What settles does so as in an evaluation, which puts a state in after a reset: the controller has
    the reset's posture. What does not, and what starts too far from home for a reset, such as most demonstrations
    of ``demos expand --starts wide``, is held where it is.
    """
    # After the time, a flattened state has the arm's seven joints.
    near = float(np.linalg.norm(demo.init_state[1:8] - HOME_RAD)) <= SCATTER_RAD
    return Scene(
        model_xml,
        demo.init_state,
        gripper=1.0 if demo.actions[0, 6] > 0 else -1.0,
        posture_rad=tuple(HOME_RAD.tolist()) if settles and near else None,
    )


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
