"""Compilation of all Numba loops that a run uses, robosuite's and ours.

``setup.sh`` calls ``python -m pipeline.validation.loops`` once. Otherwise the processes that first need a loop
compile it, several at a time.
"""

import numpy as np

from pipeline import seeding
from pipeline.axes.language import distance
from pipeline.axes.noise import NoiseAxis
from pipeline.episode_schema import SCHEMA
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.run.machine import trial


def compile_all() -> None:
    """Call every compiled function; functions that were compiled before take no time.

    Raises:
        PipelineError: when nothing renders on this machine.
    """
    trial()
    frame = np.zeros(SCHEMA.frame.shape, np.uint8)
    axis = NoiseAxis()
    for levels in (axis.motion, axis.gaussian_blur, axis.zoom, axis.fog, axis.glass):
        levels[0].apply(frame, seeding.rng("loops"))
    distance("one wording", "another")


if __name__ == "__main__":
    ensure_fixed_machine_code()
    compile_all()
