"""Model server with closed eyes: its policy moves the hand to a fixed place. docs/model-server.md explains it.

python examples/model_server.py --address 127.0.0.1:8000
"""

from typing import Any

import numpy as np
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import (
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_EEF_POS_AA_GRIP,
    DimSpec,
)

UNIT_M = 0.05
"""Distance that the controller commands for an action of 1."""

CHUNK = 10
"""Number of actions in each answer."""


class ClosedEyes(PredictModelServer):  # type: ignore[misc]
    """Server whose policy moves the hand to a place (x, y, z) in m in the world frame, with the gripper open."""

    def __init__(self, *, x_m: float = 0.0, y_m: float = 0.1, z_m: float = 1.1):
        super().__init__()
        self._place_m = np.array([x_m, y_m, z_m])

    def predict(self, obs: dict[str, Any], ctx: SessionContext) -> dict[str, Any]:
        """Return a chunk of actions (10, 7). A policy with open eyes also uses the images and the instruction."""
        distance_m = self._place_m - obs["states"][:3]
        action = np.zeros(7)
        action[:3] = np.clip(distance_m / (CHUNK * UNIT_M), -1.0, 1.0)
        action[6] = -1.0  # open
        return {"actions": np.tile(action, (CHUNK, 1))}

    def get_observation_params(self) -> dict[str, Any]:
        """Ask for the wrist view, and for the state with the axis-angle of the datasets."""
        return {"send_wrist_image": True, "send_state": True, "quat_no_antipodal": True}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Declare deltas of position and axis-angle, and a gripper that closes at 1."""
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Declare the parts of an observation that the policy uses."""
        return {"image": IMAGE_RGB, "state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}


if __name__ == "__main__":
    run_server(ClosedEyes)
