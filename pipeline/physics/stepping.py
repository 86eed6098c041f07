"""LIBERO's control step without the parts that change no state: the same states, bit for bit."""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from pipeline.types import Floats


class ControlStep:
    """One scene's control step, 50 ms in 25 substeps, as robosuite 1.4.0 takes it.

    A substep of robosuite's runs MuJoCo's whole forward dynamics three times on one state: before the controller,
    inside the controller's update, and inside ``mj_step``. What can differ between them is the solver, which starts
    from its last result, and, once torques are set, what follows from them. So the second is the constraint solver
    alone and the third is ``mj_step2``. None of the solves can be left out: each changes the start of the next by very
    little, and contacts amplify that to decimetres before a demonstration ends.

    Of ``mj_step``, only its check for positions and velocities beyond 1e10 is missing; that of accelerations, which
    comes first when a scene explodes, is part of ``mj_step2``. LIBERO's scenes are integrated by Euler's method.

    The controller is robosuite's own and computes the torques; only its ``update`` is replaced here. Observables,
    rewards and buffers of recent values, which change no state, are left out.

    Args:
        env: LIBERO's environment (the one inside ``ControlEnv``), restored; a later reset of it needs a new instance.
    """

    def __init__(self, env: Any):
        self._env = env
        robot = env.robots[0]
        self._controller, self._gripper = robot.controller, robot.gripper
        self._model, self._data = env.sim.model._model, env.sim.data._data
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._site = env.sim.model.site_name2id(self._controller.eef_name)
        # The joints of an arm, which is a chain of bodies, have consecutive addresses.
        self._arm_qpos, self._arm_dofs = (
            slice(first, first + self._controller.joint_dim)
            for first in (self._controller.qpos_index[0], self._controller.qvel_index[0])
        )
        self._jacobian, self._mass = np.empty((6, self._model.nv)), np.empty((self._model.nv, self._model.nv))
        self._positional, self._rotational = self._jacobian[:3], self._jacobian[3:]
        self._arm_torque = robot._ref_joint_actuator_indexes
        self._low, self._high = robot.torque_limits
        self._fingers = robot._ref_joint_gripper_actuator_indexes
        low, high = self._model.actuator_ctrlrange[self._fingers].T
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def __call__(self, action: Floats) -> None:
        """Take the step.

        Args:
            action: (7,) OSC_POSE deltas and gripper; the controller clips the deltas to [-1, 1].
        """
        for _ in self.substeps(action):
            pass

    def substeps(self, action: Floats) -> Iterator[None]:
        """Take the step and stop after each substep.

        Positions and velocities are then those after the substep, and what follows from them, such as where sites are,
        is still that before it, as when robosuite observes.
        """
        model, data, controller = self._model, self._data, self._controller
        for substep in range(self._substeps):
            mujoco.mj_forward(model, data)
            # In the first substep after a restore the controller is up to date already.
            if controller.new_update:
                mujoco.mj_fwdConstraint(model, data)
                self._update()
            if substep == 0:
                controller.set_goal(action[:6])
            data.ctrl[self._arm_torque] = np.clip(controller.run_controller(), self._low, self._high)
            data.ctrl[self._fingers] = self._middle + self._half * self._gripper.format_action(action[6:])
            mujoco.mj_step2(model, data)
            yield
        self._env._post_process()

    def _update(self) -> None:
        """Give the controller what its own ``update`` would read, computed once and from addresses already known.

        Jacobians and mass matrix are stored by columns, as robosuite's indexing leaves them: the layout selects the
        BLAS routine, and the routine determines the last bits.
        """
        model, data, arm = self._model, self._data, self._controller
        mujoco.mj_jacSite(model, data, self._positional, self._rotational, self._site)
        mujoco.mj_fullM(model, self._mass, data.qM)
        arm.ee_pos = data.site_xpos[self._site].copy()
        arm.ee_ori_mat = data.site_xmat[self._site].reshape(3, 3).copy()
        arm.ee_pos_vel = np.dot(self._positional, data.qvel)
        arm.ee_ori_vel = np.dot(self._rotational, data.qvel)
        arm.joint_pos = data.qpos[self._arm_qpos].copy()
        arm.joint_vel = data.qvel[self._arm_dofs].copy()
        arm.J_full = np.asfortranarray(self._jacobian[:, self._arm_dofs])
        arm.J_pos = np.asfortranarray(self._positional[:, self._arm_dofs])
        arm.J_ori = np.asfortranarray(self._rotational[:, self._arm_dofs])
        arm.mass_matrix = np.asfortranarray(self._mass[self._arm_dofs, self._arm_dofs])
        arm.new_update = False
