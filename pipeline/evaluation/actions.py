"""Checks of a policy's answer: finite numbers, in the action format of LIBERO's controller."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from pipeline.errors import PipelineError
from pipeline.types import Floats


class PolicyError(PipelineError):
    """Error of a policy that gave no action: this episode has no result, other episodes may have one."""


def checked_actions(answer: Any, policy: str) -> Floats:
    """Return a policy's answer, one action (7,) or several, as an (n, 7) array.

    Raises:
        PolicyError: if the answer is not finite numbers of these shapes.
    """
    expected = "(7,) or (n, 7) finite numbers: three of position, three of rotation, and the gripper"
    try:
        actions = np.asarray(answer, np.float64)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"the policy's answer is not numbers ({error})", where=policy, expected=expected) from error
    if actions.ndim not in (1, 2) or actions.shape[-1] != 7 or not actions.size:
        raise PolicyError(f"the policy answers with shape {actions.shape}", where=policy, expected=expected)
    if not np.isfinite(actions).all():
        raise PolicyError("the policy answers with NaN or infinity", where=policy, expected=expected)
    return np.atleast_2d(actions)


Actions = Literal["delta", "absolute"]
"""Content of a policy's actions: deltas, or goals of position and orientation in the world; ``docs/`` compares them."""

FORMATS = {
    # X-VLA's server announces delta_xyz, and its absolute actions by a parameter.
    "position": ("delta_xyz", "absolute_xyz", "raw"),
    # GR00T's server announces euler_xyz, but its policy learns axis-angles from LIBERO's data.
    "rotation": ("axis_angle", "euler_xyz", "raw"),
    "gripper": ("binary_close_positive", "raw"),
}
"""Part of an action to the formats that can be executed, in vla-eval's names; ``raw`` leaves the format open."""


def reject_other_actions(
    params: Mapping[str, Any], spec: Mapping[str, Mapping[str, Any]], server: str, actions: Actions
) -> None:
    """Reject a model server with other actions than the evaluation executes, or with another gripper command.

    Args:
        params: the ``observation_params`` that the server announces.
        spec: the ``action_spec`` that the server announces.
        actions: the actions that the evaluation executes.

    Raises:
        PipelineError: if the server announces other actions.
    """
    unsupported = []
    for part, dimension in spec.items():
        if dimension["format"] not in FORMATS.get(part, ("raw",)):
            unsupported.append(f"{part} {dimension['format']}")
    if unsupported:
        raise PipelineError(
            f"the server's actions cannot be executed: it announces {', '.join(unsupported)}",
            where=server,
            expected="position, axis-angle, and a gripper that opens below 0 and else closes",
            remedy="start GR00T's server with --args.invert_gripper true",
        )
    position = spec.get("position", {}).get("format")
    announced = "absolute" if params.get("absolute_action") or position == "absolute_xyz" else "delta"
    # A server may leave the format open.
    if announced != actions and (announced == "absolute" or position == "delta_xyz"):
        raise PipelineError(
            f"the server announces {announced} actions, and the evaluation executes {actions} ones",
            where=server,
            expected="equal actions of server and evaluation",
            remedy=f"evaluate with --actions {announced}; in the harness, with the setting `actions: {announced}`",
        )
