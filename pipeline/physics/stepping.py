"""LIBERO's control step without the parts that change no state; its states are equal to LIBERO's, bit for bit."""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from pipeline.physics.robosuite_1_4 import data_of, finish_action, model_of
from pipeline.types import Floats


class ControlStep:
    """One scene's control step, 50 ms in 25 substeps, as robosuite 1.4.0 takes it.

    A substep of robosuite runs MuJoCo's whole forward dynamics three times on one state: before the controller, inside
    the controller's update, and inside ``mj_step``. Two results can differ between the three runs. The solver starts
    from its last result. Once torques are set, the quantities that depend on them change. The second run is therefore
    the constraint solver alone, and the third run is ``mj_step2``. No solve can be left out: each solve changes the
    start of the next by very little, and contacts amplify this to decimetres before a demonstration ends.

    Only one part of ``mj_step`` is missing: its check for positions and velocities beyond 1e10. The check of
    accelerations, which fails first when a scene explodes, is part of ``mj_step2``. LIBERO's scenes are integrated by
    Euler's method.

    robosuite's own controller computes the torques; only its ``update`` is replaced here. Observables, rewards and
    buffers of recent values change no state and are left out.

    Args:
        env: LIBERO's restored environment (the object inside ``ControlEnv``). After a later reset of it, create a new
            ``ControlStep``.
    """

    def __init__(self, env: Any):
        self._env = env
        robot = env.robots[0]
        self._controller, self._gripper = robot.controller, robot.gripper
        self._model, self._data = model_of(env.sim), data_of(env.sim)
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._site = env.sim.model.site_name2id(self._controller.eef_name)
        # The joints of an arm, which is a chain of bodies, have consecutive addresses.
        first_qpos, first_dof = self._controller.qpos_index[0], self._controller.qvel_index[0]
        self._arm_qpos = slice(first_qpos, first_qpos + self._controller.joint_dim)
        self._arm_dofs = slice(first_dof, first_dof + self._controller.joint_dim)
        self._jacobian, self._mass = np.empty((6, self._model.nv)), np.empty((self._model.nv, self._model.nv))
        self._positional, self._rotational = self._jacobian[:3], self._jacobian[3:]
        self._arm_torque = [env.sim.model.actuator_name2id(name) for name in robot.robot_model.actuators]
        self._low, self._high = robot.torque_limits
        self._fingers = [env.sim.model.actuator_name2id(name) for name in self._gripper.actuators]
        low, high = self._model.actuator_ctrlrange[self._fingers].T
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def __call__(self, action: Floats) -> None:
        """Execute the control step.

        Args:
            action: (7,) OSC_POSE deltas and gripper; the controller clips the deltas to [-1, 1].
        """
        for _ in self.substeps(action):
            pass

    def substeps(self, action: Floats) -> Iterator[None]:
        """Execute the control step and yield after each substep.

        At each yield, positions and velocities are up to date. Quantities derived from them, such as positions of
        sites, are still those before the substep. robosuite observes in this state too.
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
        finish_action(self._env)

    def _update(self) -> None:
        """Give the controller the values that its own ``update`` would read.

        They are computed once, and the arm's addresses are not looked up again.

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
