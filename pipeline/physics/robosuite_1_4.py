"""Internals of robosuite 1.4.0 and LIBERO that have no public interface; no other module uses them."""

from typing import Any

import mujoco
import numpy as np


def model_of(sim: Any) -> mujoco.MjModel:
    """Return MuJoCo's model behind robosuite's ``MjSim``: functions of ``mujoco`` do not accept robosuite's wrapper."""
    return sim.model._model


def data_of(sim: Any) -> mujoco.MjData:
    """Return MuJoCo's data behind robosuite's ``MjSim``: functions of ``mujoco`` do not accept robosuite's wrapper."""
    return sim.data._data


def finish_action(env: Any) -> None:
    """Perform the last part of LIBERO's ``step``: it updates the objects' states, such as a lit burner.

    The public interface performs it only with a whole step, or with the computation of all observations.

    Args:
        env: the object inside LIBERO's ``ControlEnv``.
    """
    env._post_process()


def copy_controller(controller: Any) -> dict[str, Any]:
    """Return a copy of a controller's attributes, including their arrays.

    The controller's ``reset_goal`` resets the goal alone, not the measured values from which torques are computed.
    """
    return {name: _copied(value) for name, value in vars(controller).items()}


def restore_controller(controller: Any, attributes: dict[str, Any]) -> None:
    """Set a controller's attributes to a copy of the attributes that ``copy_controller`` returned."""
    vars(controller).update({name: _copied(value) for name, value in attributes.items()})


def _copied(value: Any) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value
