"""Display lists of OpenGL, and how MuJoCo is made to call them; its context must be the current one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from pipeline.rendering.opengl import calls


def new(count: int = 1) -> int:
    """The first number of so many new lists, which do nothing yet."""
    number: int = calls().glGenLists(count)
    return number


def free(number: int, count: int = 1) -> None:
    """Have OpenGL forget so many lists."""
    calls().glDeleteLists(number, count)


@contextmanager
def recorded(number: int) -> Iterator[None]:
    """Have a list do, whenever it is called, what OpenGL is asked to do meanwhile."""
    calls().glNewList(number, calls().GL_COMPILE)
    try:
        yield
    finally:
        calls().glEndList()


def add(number: int, scene: mujoco.MjvScene, context: mujoco.MjrContext) -> None:
    """Have a list called by MuJoCo as if it were one more mesh of a scene, after all others that are opaque."""
    geom = scene.geoms[scene.ngeom]
    white, nowhere, straight = np.ones(4, np.float32), np.zeros(3), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_MESH, nowhere, nowhere, straight, white)
    # As mjCAT_DECOR, which mjv_initGeom makes it, it would not be called for shadows.
    geom.category, geom.dataid = mujoco.mjtCatBit.mjCAT_DYNAMIC, number - context.baseMesh
    # What mjv_initGeom leaves as it was: nothing to write beside it, and nothing to show of it in a segmentation.
    geom.label, geom.segid = "", -1
    scene.ngeom += 1
