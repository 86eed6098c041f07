"""State relative to the first frame of its episode (arXiv:2605.13067), for policies with proprioception."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

POSITION, ORIENTATION = slice(0, 3), slice(3, 6)
"""Parts of a state (8,): position of the hand in m, its orientation as a rotation vector in rad, then both fingers."""


def relative(states: NDArray[np.float32], first: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return states (N, 8) with the hand's pose in the frame of the hand in the ``first`` state (8,)."""
    start = Rotation.from_rotvec(first[ORIENTATION])
    result = states.copy()
    result[:, POSITION] = start.inv().apply(states[:, POSITION] - first[POSITION])
    result[:, ORIENTATION] = (start.inv() * Rotation.from_rotvec(states[:, ORIENTATION])).as_rotvec()
    return result


def relative_by_episode(states: NDArray[np.float32], lengths: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the states (N, 8) of episodes of ``lengths`` (E,), each relative to the first of its episode."""
    parts = np.split(states, np.cumsum(lengths)[:-1])
    return np.concatenate([relative(part, part[0]) for part in parts])
