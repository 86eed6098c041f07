"""Checks of a recording's control frequency and controller gains. Replay uses LIBERO's."""

import json
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.assets import package_folder
from pipeline.types import Floats

NAMED_IN = ("env_args", "env_info")
"""Attributes of ``data`` with the environment's arguments as JSON: first LIBERO's and robomimic's, then robosuite's."""

UNUSED = ("kp_limits", "damping_ratio_limits", "ramp_ratio")
"""Settings of the controller that have no effect with fixed gains and without interpolation."""

TIME_TOLERANCE_S = 1e-3

RECORD_AGAIN = (
    "record with LIBERO's settings, or convert actions and states to them in a copy; leave these demonstrations out of "
    "demos.tasks until then"
)


def reject_other_control(data: h5py.Group, where: str) -> None:
    """Compare the control frequency and the controller that a file states with LIBERO's; a file may state none.

    Raises:
        PipelineError: when values differ; it lists all of them.
    """
    for attribute in NAMED_IN:
        if attribute not in data.attrs:
            continue
        differences = list(_differences(_arguments(data, attribute, where)))
        if differences:
            raise PipelineError(
                f"the file was recorded with other settings than LIBERO's: {'; '.join(differences)} ({attribute})",
                where=where,
                expected=f"control_freq {SCHEMA.fps_hz}, and robosuite's controllers/config/osc_pose.json",
                remedy=RECORD_AGAIN,
            )


def reject_other_rate(states: Floats, where: str) -> None:
    """Compare the median distance in time of states (T, S) with a control step; constant time is accepted too.

    The distance of single steps may differ, for example if no-ops were left out.

    Raises:
        PipelineError: when the rates differ; it states both.
    """
    if len(states) < 2:
        return
    spacing_s = float(np.median(np.diff(states[:, 0])))
    if spacing_s != 0 and abs(spacing_s - 1 / SCHEMA.fps_hz) > TIME_TOLERANCE_S:
        raise PipelineError(
            f"its states are {spacing_s:.6g} s apart ({1 / spacing_s:.4g} Hz)",
            where=where,
            expected=f"{1 / SCHEMA.fps_hz:g} s ({SCHEMA.fps_hz} Hz) by their first column, the time",
            remedy=RECORD_AGAIN,
        )


def _arguments(data: h5py.Group, attribute: str, where: str) -> dict[str, Any]:
    """Read the arguments that the environment was created with."""
    try:
        named = json.loads(hdf5.text(data, attribute, where))
        arguments = named.get("env_kwargs", named)
        return dict(arguments)
    except (ValueError, TypeError, AttributeError) as error:
        raise PipelineError(
            f"attribute {attribute!r} is not a JSON object ({error})",
            where=where,
            expected="the arguments of the environment that recorded it, as LIBERO's create_dataset.py writes them",
            remedy="correct the attribute in a copy of the file",
        ) from error


def _differences(arguments: dict[str, Any]) -> Iterator[str]:
    """Describe each difference between an environment's arguments and LIBERO's."""
    frequency = arguments.get("control_freq", SCHEMA.fps_hz)
    if not _equal(frequency, SCHEMA.fps_hz):
        yield f"control_freq {frequency}, not {SCHEMA.fps_hz}"
    controller = arguments.get("controller_configs")
    if isinstance(controller, list) and len(controller) == 1:
        controller = controller[0]
    if controller is None:
        return
    if not isinstance(controller, dict):
        yield f"controller_configs {controller}, not one controller"
        return
    libero_controller = package_folder("robosuite") / "controllers" / "config" / "osc_pose.json"
    for name, expected in json.loads(libero_controller.read_text()).items():
        if name in controller and name not in UNUSED and not _equal(controller[name], expected):
            yield f"{name} {controller[name]}, not {expected}"


def _equal(value: Any, expected: Any) -> bool:
    """Return whether two settings are equal; as in robosuite, a number equals a list that repeats it."""
    if isinstance(expected, bool) or not isinstance(expected, int | float | list):
        return bool(value == expected)
    try:
        return bool(np.all(np.asarray(value, np.float64) == np.asarray(expected, np.float64)))
    except (TypeError, ValueError):
        return False
