"""Space that a demonstration moves through, and surfaces that added objects may stand on."""

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.libero.arenas import SURFACES
from pipeline.types import Floats

_RAY_GROUP = 5


class SweptPath:
    """A copy of a model that detects only forbidden contacts: an added object with anything but a surface.

    Args:
        model: the scene with the objects; the objects' joints are the last.
        added: (ngeom,) mask of the objects' geoms.
        path: (K+1, nq) positions of all other joints along the demonstration.
    """

    def __init__(self, model: mujoco.MjModel, added: NDArray[np.bool_], path: Floats):
        self._model, self._added, self._path = copy.copy(model), added, path
        model = self._model
        numbers = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in SURFACES)
        surfaces = [number for number in numbers if number >= 0]
        roots = model.body_rootid[model.geom_bodyid]
        touches = (model.geom_contype | model.geom_conaffinity) != 0
        stands_on = touches & np.isin(roots, [*surfaces, 0])
        model.geom_contype[:] = np.where(added, 2, 1) * (touches & ~stands_on)
        model.geom_conaffinity[:] = np.where(added, 3, 0) * touches
        for body in range(model.nbody):
            geoms = model.geom_bodyid == body
            model.body_contype[body] = np.bitwise_or.reduce(model.geom_contype[geoms], initial=0)
            model.body_conaffinity[body] = np.bitwise_or.reduce(model.geom_conaffinity[geoms], initial=0)
        model.geom_group[:] = np.where(touches & (roots == surfaces[0]), _RAY_GROUP, 0)
        self._data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)

    def clear(self, poses: Floats, clearance_m: float) -> bool:
        """Return whether objects at poses (N, 7) keep a clearance during the whole demonstration.

        Each object must be at least ``clearance_m`` away from the other objects and from everything else but a surface.
        """
        model, data = self._model, self._data
        model.geom_margin[self._added] = clearance_m
        model.body_margin[model.geom_bodyid[self._added]] = clearance_m
        data.qpos[-poses.size :] = poses.ravel()
        for positions in self._path:
            data.qpos[: -poses.size] = positions
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                return False
        return True

    def height(self, at_m: Floats) -> float:
        """Return the height in m of the working surface at (x, y); minus infinity outside of the surface."""
        above, down = np.array([*at_m, 3.0]), np.array([0.0, 0.0, -1.0])
        groups = (np.arange(6) == _RAY_GROUP).astype(np.uint8)
        hit = np.array([-1], np.int32)
        distance = mujoco.mj_ray(self._model, self._data, above, down, groups, 1, -1, hit)
        return float(above[2] - distance) if hit[0] >= 0 else -np.inf
