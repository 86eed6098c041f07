"""The passes of MuJoCo 3.2.7's ``mjr_render``, and the limits that it has.

Each pass renders all opaque geoms in the order of the scene, skins included. Transparent geoms come last. The shadow
map of a light has no geoms of the category decor.
"""

from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

OPAQUE = 0.995
"""MuJoCo's least opacity of what it does not take to be seen through (``mjr_render``)."""

WIDEST_MAP_DEG = 80.0
"""Half the widest angle of MuJoCo's maps of what casts shadows (``mjr_render``)."""

REFLECTING_SQUARE = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
"""Corners of a box's upper z face, which is what reflects (``mjr_render``), in units of its half sizes."""


class Purpose(Enum):
    """The kinds of passes of ``mjr_render``, in their order; the last two come once for each light with shadows."""

    MIRROR = auto()
    """What shows in the mirror."""
    CAMERA = auto()
    """What the camera sees."""
    LAMP_MAP = auto()
    """What casts shadows, as the lamp sees it."""
    LAMP_LIGHT = auto()
    """What the camera sees, once more, in this lamp's light."""

    @property
    def by_camera(self) -> bool:
        return self in (Purpose.CAMERA, Purpose.LAMP_LIGHT)


class Pass(NamedTuple):
    """One pass, and a mask (ngeom,) of the geoms whose meshes it has to render."""

    purpose: Purpose
    geoms: NDArray[np.bool_]
