"""Passes and limits of MuJoCo 3.2.7's ``mjr_render``.

Each pass renders all opaque geoms in the order of the scene, including skins. Transparent geoms come last. The shadow
map of a light has no geoms of the category decor.
"""

from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

OPAQUE = 0.995
"""Least opacity of geoms that MuJoCo renders as opaque (``mjr_render``)."""

WIDEST_MAP_DEG = 80.0
"""Half the widest angle of MuJoCo's shadow maps (``mjr_render``)."""

REFLECTING_SQUARE = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
"""Corners of a box's upper z face, which is its reflecting face (``mjr_render``), in units of the box's half sizes."""


class Purpose(Enum):
    """Kinds of passes of ``mjr_render``, in their order; the last two come once for each light with shadows."""

    MIRROR = auto()
    """Mirror images."""
    CAMERA = auto()
    """The camera's view."""
    LAMP_MAP = auto()
    """The shadow map: geoms that cast shadows, from the lamp's view."""
    LAMP_LIGHT = auto()
    """The camera's view, rendered once more in this lamp's light."""

    @property
    def by_camera(self) -> bool:
        """Return whether the pass renders the camera's view."""
        return self in (Purpose.CAMERA, Purpose.LAMP_LIGHT)


class Pass(NamedTuple):
    """Pass with a mask (ngeom,) of the geoms whose meshes it has to render."""

    purpose: Purpose
    geoms: NDArray[np.bool_]
