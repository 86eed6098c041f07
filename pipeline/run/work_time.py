"""Time that finished trajectories and frames took, or would take: measured figures, scaled to a machine's speed.

Times are CPU times of one core of the machine that ``REFERENCE`` describes: of frames 0.8 of what
``benchmarks/frame_cost.py`` gave beside other work, so that they sum up to the stage of ``configs/starter.yaml``.
"""

from pipeline.libero.bddl import Arena
from pipeline.run.machine import Speed

REFERENCE = Speed(step_s=0.0033, frame_s=0.093)
"""Of the machine of the figures below, by ``machine.trial``: one step again and again, and a frame without savings."""

FRAME_S: dict[Arena, tuple[float, float]] = {
    "tabletop": (0.032, 0.041),
    "floor": (0.022, 0.034),
    "kitchen": (0.041, 0.033),
    "living_room": (0.024, 0.047),
    "study": (0.028, 0.035),
}
"""A frame of the agent view and of the wrist view, with savings."""
ENCODE_S = 0.004
"""Of a frame: the JPEG, and the noise where there is some. A GPU does not make it quicker."""
SCENE_S, STEP_S, TRIES = 2.2, 0.007, 1.4
"""A trajectory besides its control steps; a step; how often steps are run, as tracking follows a replay that missed."""


def replay_s(steps: float, speed: Speed) -> float:
    """Seconds of one core to replay a trajectory of so many steps."""
    return speed.step_s / REFERENCE.step_s * (SCENE_S + TRIES * steps * STEP_S)


def frame_s(speed: Speed) -> float:
    """Seconds of one core, or of all GPUs, to render and encode a frame: the mean of all arenas and both views."""
    if speed.gpus:
        return speed.frame_s / speed.gpus + ENCODE_S
    views_s = [view_s for views in FRAME_S.values() for view_s in views]
    return speed.frame_s / REFERENCE.frame_s * sum(views_s) / len(views_s) + ENCODE_S
