"""LIBERO's own environment for one task, without rendering: the physics, the controller and the judge's predicates."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.types import Floats, Task


def _control_env() -> Any:
    """LIBERO's ``ControlEnv`` class, imported without GL when none was chosen and without robosuite's banner."""
    logging.disable(logging.WARNING)
    try:
        if "MUJOCO_GL" not in os.environ:
            # Physics needs no GL: without this, robosuite loads EGL on import and fails on a node without it.
            os.environ["MUJOCO_GL"] = "disable"
            import robosuite.macros

            robosuite.macros.MUJOCO_GPU_RENDERING = False
        from libero.libero.envs.env_wrapper import ControlEnv
    finally:
        logging.disable(logging.NOTSET)
    return ControlEnv


class Environment:
    """One task's environment; every ``restore`` forgets what happened before it.

    Building one parses the BDDL file and loads every mesh (1 to 2.5 s), restoring a scene recompiles its model
    (0.4 to 1 s), so keep an environment for all demonstrations of its task.

    Args:
        task: the task to build.
    """

    def __init__(self, task: Task):
        self.task = task
        with _seeded(0):
            self._env = _control_env()(
                bddl_file_name=str(task.bddl_file),
                has_renderer=False,
                has_offscreen_renderer=False,
                use_camera_obs=False,
                ignore_done=True,
            )

    def place_fixtures(self, seed: int) -> str:
        """The scene as LIBERO's own reset makes it under ``seed``, as MJCF.

        For demonstrations whose source did not record the scene: movable objects are put where the recorded state
        says, but fixtures (cabinet, stove, rack, microwave) are not part of it and stay where the reset put them.
        """
        with _seeded(seed):
            self._env.reset()
        return str(self._env.sim.model.get_xml())

    def restore(self, model_xml: str, state: Floats) -> None:
        """Put the environment into a recorded scene and state, as if nothing had ever happened in this process.

        Args:
            model_xml: MJCF of the scene.
            state: (S,) flattened MuJoCo state: time, qpos, qvel.
        """
        env = self._env
        env.reset_from_xml_string(model_xml)
        # The gripper model survives the reset with its last command, which the next command is added to.
        env.robots[0].gripper.current_action = np.zeros(env.robots[0].gripper.dof)
        env.sim.reset()
        expected = 1 + env.sim.model.nq + env.sim.model.nv
        if len(state) != expected:
            raise PipelineError(
                f"the recorded state has {len(state)} numbers, the scene's has {expected}",
                where=f"{self.task.suite}/{self.task.name}",
                expected="time, qpos and qvel of the same model",
                remedy="use demonstrations recorded with this LIBERO version, or ones that carry their model_file",
            )
        env.set_state(state)
        env.sim.forward()
        env._post_process()

    def step(self, action: Floats) -> None:
        """Run one control step (50 ms) with an OSC_POSE action (7,) in [-1, 1]."""
        self._env.step(action)

    @property
    def state(self) -> Floats:
        """(S,) flattened MuJoCo state: time, qpos, qvel."""
        return np.asarray(self._env.get_sim_state(), np.float64)

    @property
    def site_alpha(self) -> NDArray[np.float32]:
        """(nsite,) opacity of each site; LIBERO lights a stove's burner by making its site visible."""
        return np.array(self._env.sim.model.site_rgba[:, 3], np.float32)

    def succeeded(self) -> bool:
        """LIBERO's success check, the conjunction of the BDDL goal's predicates."""
        return bool(self._env.check_success())

    def close(self) -> None:
        self._env.close()


class _seeded:  # noqa: N801 - reads as a verb where it is used
    """LIBERO's samplers draw from numpy's global generator: seed it for a moment, then put it back."""

    def __init__(self, seed: int):
        self._seed = seed

    def __enter__(self) -> None:
        self._saved = np.random.get_state()
        np.random.seed(self._seed)

    def __exit__(self, *_: object) -> None:
        np.random.set_state(self._saved)
