"""Whether what an instruction says of where its objects stand is still so."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache

import numpy as np

from pipeline.libero import bddl
from pipeline.types import Floats, Task

NEXT_TO_M = 0.17
"""Distance of centres up to which things stand next to each other; in LIBERO it is 0.12 to 0.13 m."""

BETWEEN = 0.25
"""Share of the way between two things that still counts as at one of them, and as beside the line between them."""


@cache
def _alike(task: Task, thing: str) -> tuple[str, ...]:
    """The other objects of the category of ``thing``."""
    objects = bddl.read(task.bddl_file).objects
    return tuple(name for name, category in objects.items() if category == objects[thing] and name != thing)


@cache
def _anchors(task: Task, thing: str) -> tuple[str, ...]:
    """The one thing that an object starts next to, or the two that it starts between; none where neither is said."""
    places = bddl.read(task.bddl_file).places
    # Such as main_table_between_plate_ramekin_region: the plate starts in main_table_plate_region.
    found = re.fullmatch(r"(\w+?)_(?:next_to_([a-z]+)|between_([a-z]+)_([a-z]+))_region", places.get(thing, ""))
    if found is None:
        return ()
    surface, *words = (word for word in found.groups() if word)
    at = {region: name for name, region in places.items()}
    return tuple(at[f"{surface}_{word}_region"] for word in words)


def relation_holds(task: Task, target: str, xy_m: Callable[[str], Floats]) -> bool:
    """Whether the target still stands where the instruction's words place it.

    Next to something: within ``NEXT_TO_M`` of it, and no like object nearer to it. Between two things: its foot on the
    line between them in the middle half, and off that line by at most a quarter of its length.
    """
    own = xy_m(target)
    match _anchors(task, target):
        case (anchor,):
            away = np.linalg.norm(own - xy_m(anchor))
            nearest_alike = min(
                (np.linalg.norm(xy_m(other) - xy_m(anchor)) for other in _alike(task, target)), default=math.inf
            )
            return bool(away <= min(NEXT_TO_M, nearest_alike))
        case (first, second):
            line = xy_m(second) - xy_m(first)
            dx, dy = own - xy_m(first)
            along, beside = np.array([dx * line[0] + dy * line[1], dx * line[1] - dy * line[0]]) / (line @ line)
            return bool(BETWEEN <= along <= 1 - BETWEEN and abs(beside) <= BETWEEN)
    return True
