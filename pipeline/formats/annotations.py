"""Texts about parts of an episode for lerobot's language columns: rewrites, subtasks, motions and traces.

``datasets/language.py`` of lerobot 0.6.1 defines the styles. It fixes no content of ``motion`` and ``trace``, and no
code of lerobot writes them. A trace has the form of the keypoints in lerobot's own annotations (``label``,
``point_format``), with a list of points.
"""

import json
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import ALL_VIEWS, SCHEMA
from pipeline.types import Episode, Geometry

MOTION_STEPS = 10
"""Steps (0.5 s) whose movement one text of ``motion`` describes. A trace begins at every such step.

The last text describes the remaining steps too, up to 19 in all: the movement in one or two steps has no direction.
"""

LEAST_M = 0.01
"""Least displacement along an axis within ``MOTION_STEPS`` that is called a movement."""

LEAST_DEG = 10.0
"""Least angle within ``MOTION_STEPS`` that is called a turn."""

TRACE_STEPS = 4
"""Steps (0.2 s) between two points of a trace."""

TRACE_POINTS = 11
"""Largest number of points of a trace: its own step and the next 2 s."""


class Annotation(NamedTuple):
    """A text that begins at a step.

    Attributes:
        role: speaker of the text.
        style: kind of the text, one of lerobot's styles.
        camera: column of the view whose pixels the text names; ``None`` if it names none.
    """

    role: str
    style: str
    step: int
    text: str
    camera: str | None = None

    @property
    def time_s(self) -> np.float32:
        return np.float32(self.step / SCHEMA.fps_hz)


def persistent_annotations(episode: Episode, *, train: bool) -> list[Annotation]:
    """Return the texts that stay valid until the next text of their style.

    ``task_aug`` is for training alone; its first entry is the episode's own instruction. ``active_at`` of lerobot's
    ``language_render.py`` finds subtasks and motions by their time.
    """
    annotations = []
    if train and episode.rewrites:
        wordings = dict.fromkeys([episode.instruction, *episode.rewrites])
        annotations += [Annotation("user", "task_aug", 0, text) for text in wordings]
    annotations += [Annotation("assistant", "subtask", step, text) for step, text in episode.subtasks]
    previous = ""
    starts = range(0, max(len(episode) - MOTION_STEPS, 0) + 1, MOTION_STEPS)
    for step, next_step in pairwise([*starts, len(episode)]):
        text = _motion(episode, step, next_step)
        if text != previous:
            annotations.append(Annotation("assistant", "motion", step, text))
        previous = text
    return annotations


def event_annotations(episode: Episode, size_px: int) -> list[Annotation]:
    """Return the traces of the gripper, for views whose camera does not move with it.

    A trace is JSON of the pixels (x to the right, y down) where the middle between the fingers is now and later, by the
    view's matrices. It may be hidden there. Points outside of the picture are left out; a trace of fewer than two
    points does not exist.
    """
    annotations = []
    for step in range(0, len(episode), MOTION_STEPS):
        last = min(step + (TRACE_POINTS - 1) * TRACE_STEPS, len(episode) - 1)
        path_m = episode.state[step : last + 1 : TRACE_STEPS, :3]
        for view, geometry in episode.geometry.items():
            if ALL_VIEWS[view].seen_from != "world":
                continue
            pixels = np.rint(_pixels(path_m, geometry))
            points = pixels[np.all((pixels >= 0) & (pixels < size_px), axis=1)].astype(int).tolist()
            if len(points) > 1:
                content = json.dumps({"label": "gripper", "point_format": "xy", "points": points})
                annotations.append(Annotation("assistant", "trace", step, content, ALL_VIEWS[view].lerobot_key))
    return annotations


def _motion(episode: Episode, step: int, next_step: int) -> str:
    """Describe the movement of the gripper from a step to the step of the next text, in words of LIBERO's instructions.

    Their left is -y: the robot's right. Forward is +x, the direction in which the robot of every arena looks. Turns are
    seen from above.
    """
    last = min(next_step, len(episode) - 1)
    words = _direction(episode.state[last, :3] - episode.state[step, :3])
    parts = [f"move {words}"] if words else []
    start, end = (Rotation.from_rotvec(episode.state[t, 3:6].astype(np.float64)) for t in (step, last))
    turn_deg = np.rad2deg((end * start.inv()).as_rotvec())
    if np.linalg.norm(turn_deg) >= LEAST_DEG:
        axis = int(np.argmax(np.abs(turn_deg)))
        upright = "turn counterclockwise" if turn_deg[2] > 0 else "turn clockwise"
        parts.append(upright if axis == 2 else "tilt")
    commands = np.sign(episode.action[max(step - 1, 0) : next_step, 6])
    if len(set(commands)) > 1:
        parts.append("close the gripper" if commands[-1] > 0 else "open the gripper")
    return ", ".join(parts) or "stay"


def _direction(moved_m: NDArray[np.float32]) -> str:
    """Name the directions of a displacement (3,), the largest one first; empty if it is too small."""
    names = (("forward", "backward"), ("right", "left"), ("up", "down"))
    words = []
    for axis in np.argsort(-np.abs(moved_m), kind="stable"):
        if abs(moved_m[axis]) >= LEAST_M:
            words.append(names[axis][int(moved_m[axis] < 0)])
    return " and ".join(words)


def _pixels(points_m: NDArray[np.float32], geometry: Geometry) -> NDArray[np.float64]:
    """Return the pixels (N, 2) of points (N, 3) in the frame of the extrinsics; NaN where a point is not in front."""
    into_camera = np.linalg.inv(geometry.extrinsics.astype(np.float64))
    seen_m = points_m @ into_camera[:3, :3].T + into_camera[:3, 3]
    seen_m[seen_m[:, 2] <= 0] = np.nan
    scaled = seen_m @ geometry.intrinsics.T.astype(np.float64)
    return np.asarray(scaled[:, :2] / scaled[:, 2:])
