"""Time of the generation of trajectories and frames: measured figures, scaled to a machine's speed.

Times are CPU times of one core of the machine that ``REFERENCE`` describes. The times of frames are in
``libero/arenas.py``.
"""

from pipeline.libero.arenas import ARENAS
from pipeline.run.machine import Speed

REFERENCE = Speed(step_s=0.0033, frame_s=0.093)
"""Speed of the machine of the figures below, by ``machine.trial``: one repeated step, and a frame without savings."""

ENCODE_S = 0.004
"""Time for a frame's JPEG, and for its noise if it has some. A GPU does not reduce it."""
SCENE_S, STEP_S, TRIES = 2.2, 0.007, 1.4
"""Time for a trajectory without its control steps, time for a step, and runs of each step: tracking follows a replay
that missed its goal."""


def replay_s(steps: float, speed: Speed) -> float:
    """Return the time of one core for the replay of a trajectory of ``steps``, in s."""
    return speed.step_s / REFERENCE.step_s * (SCENE_S + TRIES * steps * STEP_S)


def frame_s(speed: Speed) -> float:
    """Return the time to render and encode a frame, of one core or all GPUs, in s: the mean of arenas and views."""
    if speed.gpus:
        return speed.frame_s / speed.gpus + ENCODE_S
    views_s: list[float] = []
    for arena in ARENAS.values():
        views_s += arena.frame_s
    return speed.frame_s / REFERENCE.frame_s * sum(views_s) / len(views_s) + ENCODE_S
