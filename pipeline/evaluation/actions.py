"""What a policy may answer with: finite numbers, of the kind that LIBERO's controller takes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.types import Floats


class PolicyError(PipelineError):
    """The policy gave no action: this episode has no result, others may have one."""


def checked_actions(answer: Any, policy: str) -> Floats:
    """(n, 7) what a policy answered, one action or several.

    Raises:
        PolicyError: when it is anything but finite numbers of that shape.
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


FORMATS = {
    "position": ("delta_xyz", "raw"),
    # GR00T's server says euler_xyz of what its policy learns from LIBERO's data, which is an axis-angle.
    "rotation": ("axis_angle", "euler_xyz", "raw"),
    "gripper": ("binary_close_positive", "raw"),
}
"""Part of an action to the formats that can be executed, as vla-eval names them; ``raw`` says nothing."""


def refuse_other_actions(params: Mapping[str, Any], spec: Mapping[str, Mapping[str, Any]], server: str) -> None:
    """Have a model server answer with deltas and a gripper that opens below 0.

    Args:
        params, spec: ``observation_params`` and ``action_spec``, as the server announces them.

    Raises:
        PipelineError: when it announces other actions.
    """
    other = ["absolute_action"] if params.get("absolute_action") else []
    other += [
        f"{part} {one['format']}" for part, one in spec.items() if one["format"] not in FORMATS.get(part, ("raw",))
    ]
    if other:
        raise PipelineError(
            f"the server's actions cannot be executed: it announces {', '.join(other)}",
            where=server,
            expected="deltas of position and axis-angle, and a gripper that opens below 0 and else closes",
            remedy="GR00T's server has --args.invert_gripper for the gripper. Absolute actions, such as X-VLA's with "
            "--args.benchmark_profile libero, are executed by vla-eval's own LIBERO benchmark alone",
        )
