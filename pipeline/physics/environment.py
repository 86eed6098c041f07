"""LIBERO's own environment for one task, without rendering: the physics, the controller and the goal's predicates."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import lru_cache, partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RejectedError
from pipeline.libero.arenas import SURFACES
from pipeline.libero.assets import as_evaluated
from pipeline.libero.carried import definition_of
from pipeline.physics.control_env import control_env, seeded, until_placed
from pipeline.physics.robosuite_1_4 import data_of, finish_action, model_of
from pipeline.physics.stepping import ControlStep
from pipeline.physics.without_images import images_left_out
from pipeline.scenes.compiled import compile_for_physics, fixed_pose, grip_pose
from pipeline.scenes.flat_images import restore_images
from pipeline.types import Floats, Push, Scene, Task

DUMMY_ACTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
"""(7,) action while a scene settles: no motion, with the gripper open (OpenVLA's and LIBERO-Plus's rule)."""


class UnusableSceneError(PipelineError):
    """Error for a scene or state that cannot be simulated.

    Attributes:
        reason: ``scene_refused`` or ``state_mismatch``, as the manifest states it.
    """

    def __init__(self, reason: str, what: str, task: Task):
        super().__init__(
            what,
            where=str(task),
            expected="the scene of this task, and time, qpos and qvel of the same model",
            remedy="use demonstrations recorded with this LIBERO version, or demonstrations with a model_file",
        )
        self.reason = reason


class Environment:
    """One task's environment; every ``restore`` discards all earlier effects.

    Building an environment takes 1 to 3 s, so keep it for all demonstrations of its task.

    Args:
        task: the task, whose BDDL file describes the scene.
        scene_properties: ``floor_style`` and ``wall_style``, if they differ from those of the task's arena.
        scene_xml: absolute path of another file for the arena.
        has_images: True if the models of its resets have images, to render from.
    """

    def __init__(
        self,
        task: Task,
        scene_properties: Mapping[str, str] | None = None,
        scene_xml: str | None = None,
        has_images: bool = False,
    ):
        self.task = task
        unseen = dict.fromkeys(("has_renderer", "has_offscreen_renderer", "use_camera_obs"), False)
        arena = {"scene_properties": scene_properties, "scene_xml": scene_xml}
        build = partial(control_env(), bddl_file_name=str(task.bddl_file), ignore_done=True, **unseen, **arena)
        self._has_images = has_images
        with seeded(0), nullcontext() if has_images else images_left_out():
            self._env = until_placed(build, task)
        self._control_step = ControlStep(self._env.env)
        self._goal = definition_of(task).goal if task.goal_file else ()
        self._openings = len(self._env.env.object_property_initializers)
        self._placed: dict[int, str] = {}
        self._scene: str | None = None
        self._site_rgba: NDArray[np.float32]
        self._push: Push | None = None
        self._steps = 0

    def place_fixtures(self, seed: int) -> str:
        """Return the scene of LIBERO's own first reset under ``seed`` as MJCF.

        Use it for demonstrations whose source did not record the scene. The recorded state places movable objects. It
        has no fixtures (cabinet, stove, rack, microwave), so fixtures stay where the reset placed them. The first call
        for a seed takes 1.3 s; later calls return the stored MJCF.
        """
        if seed not in self._placed:
            self._reset_under(seed)
            self._placed[seed] = self._as_mjcf()
        return self._placed[seed]

    def reset(self, seed: int) -> str:
        """Reset the environment under ``seed`` as for LIBERO's initial states, and return the scene as MJCF; 1.3 s.

        Fixtures stand as in ``place_fixtures``, and objects in the regions of the BDDL file. The arm is at home, with
        robosuite's default noise, which LIBERO's ``ControlEnv`` leaves out. The environment keeps this state.
        """
        self._reset_under(seed, initialization_noise="default")
        return self._as_mjcf()

    def _reset_under(self, seed: int, **robot: object) -> None:
        """Reset by LIBERO's own random samples under a seed, with changed settings of robosuite's robot."""
        env = self._env.env
        # Each reset adds its samplers of open drawers and doors to those of all resets before, and samples from all of
        # them. Without this deletion, the second placement under a seed differs from the first.
        del env.object_property_initializers[self._openings :]
        self._scene = None
        usual_robot = env.robot_configs[0]  # each reset creates the robot again from it
        env.robot_configs[0] = {**usual_robot, **robot}
        try:
            with seeded(seed):
                until_placed(env.reset, self.task)
        finally:
            env.robot_configs[0] = usual_robot
        self._control_step = ControlStep(env)

    def _as_mjcf(self) -> str:
        """Return the scene that LIBERO's last reset compiled as MJCF, with the masses of an evaluation."""
        scene = ET.fromstring(self._env.sim.model.get_xml())
        if not self._has_images:
            restore_images(scene, self._env.env.image_files)
        as_evaluated(scene)
        return ET.tostring(scene, encoding="unicode")

    def restore(self, scene: Scene) -> None:
        """Put the environment into the start of a scene; earlier steps have no effect on later ones.

        Compiling a scene takes 0.2 to 0.4 s; restoring the last scene again takes 10 ms.

        Raises:
            UnusableSceneError: if MuJoCo or LIBERO rejects the scene, or if the state does not fit its model.
        """
        env = self._env.env
        self._open_or_reset(scene.model_xml)
        self._set_state(scene)
        finish_action(env)
        self._control_step = ControlStep(env)
        self._push, self._steps = scene.start.push, 0

    def _open_or_reset(self, model_xml: str) -> None:
        """Open a scene; if it is the last restored scene, reset it in place instead.

        Raises:
            UnusableSceneError: ``scene_refused`` if MuJoCo or LIBERO rejects the scene.
        """
        env = self._env.env
        if model_xml == self._scene:
            # While it steps, LIBERO changes one part of the model: the site that shows a lit burner.
            env.sim.model.site_rgba[:] = self._site_rgba
            self._reset_in_place()
            return
        self._scene = None
        try:
            self._open(model_xml)
        except (ValueError, KeyError, mujoco.FatalError) as error:
            # MuJoCo raises these errors while it compiles; robosuite raises them if the model lacks a name.
            what = f"the scene is rejected ({error!s:.300})"
            raise UnusableSceneError("scene_refused", what, self.task) from error
        self._check_names()
        self._scene, self._site_rgba = model_xml, env.sim.model.site_rgba.copy()

    def _set_state(self, scene: Scene) -> None:
        """Put robot, objects and controller into the start of the open scene.

        Raises:
            UnusableSceneError: ``state_mismatch`` if the state does not fit the model.
        """
        env, posture_rad = self._env.env, scene.start.posture_rad
        robot = env.robots[0]
        arm_qpos, arm_qvel = robot.controller.qpos_index, robot.controller.qvel_index
        # One number for each finger; robosuite's gripper keeps its last command over the reset.
        robot.gripper.current_action = scene.start.gripper * np.array([-1.0, 1.0])
        env.sim.reset()
        self._check_state(scene.state)
        env.sim.set_state_from_flattened(scene.state)
        if posture_rad is not None:
            env.sim.data.qpos[arm_qpos] = posture_rad
            env.sim.data.qvel[arm_qvel] = 0.0
        env.sim.forward()
        # After a reset in an evaluation, the controller knows the arm's posture. Its null space pulls the arm to this
        # posture, not to robosuite's home posture. Do the same here.
        robot.controller.update_initial_joints(env.sim.data.qpos[arm_qpos])
        if posture_rad is not None:
            # LIBERO-Plus sets an initial state after a reset with another posture. Until the end of the first substep,
            # its controller still uses the posture of the reset. Do the same here.
            env.sim.set_state_from_flattened(scene.state)
            env.sim.forward()

    def settle(self, steps: int) -> None:
        """Keep the arm still, with the gripper open, for some control steps, while arm and objects come to rest.

        Raises:
            RejectedError: see ``step``.
        """
        # A push counts its steps from the first observation, which follows the settling.
        self._steps = -steps
        for _ in range(steps):
            self.step(DUMMY_ACTION)

    def _open(self, model_xml: str) -> None:
        """Open a scene like robosuite's ``reset_from_xml_string``, but reuse a recently compiled model."""
        from robosuite.utils.binding_utils import MjSim

        env, model = self._env.env, copy.copy(compile_for_physics(model_xml))
        env.close()
        env.sim = MjSim(model)
        env.sim.forward()
        env.initialize_time(env.control_freq)
        self._reset_in_place()

    def _reset_in_place(self) -> None:
        """Call LIBERO's reset on the current scene; without this setting, LIBERO would sample a new scene."""
        self._env.env.deterministic_reset = True
        try:
            self._env.env.reset()
        finally:
            self._env.env.deterministic_reset = False

    def _check_names(self) -> None:
        """Check the names that are looked up later and that LIBERO's own reset has not looked up.

        Raises:
            UnusableSceneError: ``scene_refused`` if the model lacks a camera, a joint, a region of the goal, or a
                working surface.
        """
        env, model = self._env.env, self._env.env.sim.model
        names_by_needed = {view.camera: model.camera_names for view in SCHEMA.views.values()}
        for thing in env.objects_dict.values():
            for joint in thing.joints:
                names_by_needed[joint] = model.joint_names
        for _, *arguments in self._goal or env.parsed_problem["goal_state"]:
            regions = [name for name in arguments if env.object_states_dict[name].object_state_type == "site"]
            names_by_needed |= dict.fromkeys(regions, model.site_names)
        missing = [needed for needed, names in names_by_needed.items() if needed not in names]
        if not set(SURFACES) & set(model.body_names):
            missing.append(" or ".join(SURFACES))
        if missing:
            raise UnusableSceneError("scene_refused", f"the scene has no {', '.join(missing)}", self.task)

    def _check_state(self, state: Floats) -> None:
        """Check the length of a state (S,) and the rotations in it.

        Raises:
            UnusableSceneError: ``state_mismatch`` for another length or a rotation of length 0.
        """
        model = model_of(self.sim)
        expected = 1 + model.nq + model.nv
        if len(state) != expected:
            what = f"the recorded state has {len(state)} numbers, the scene's has {expected}"
            raise UnusableSceneError("state_mismatch", what, self.task)
        free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        # The state begins with the time, and a free joint's qpos begins with its position (3,).
        rotations = state[4 + model.jnt_qposadr[free_joints, None] + np.arange(4)]
        for joint in free_joints[~rotations.any(axis=1)]:
            what = f"the recorded state gives {model.joint(joint).name} a rotation of length 0"
            raise UnusableSceneError("state_mismatch", what, self.task)

    def step(self, action: Floats) -> None:
        """Run one control step (50 ms) with an OSC_POSE action (7,) in [-1, 1].

        Raises:
            RejectedError: ``simulation_unstable`` if the numbers grow beyond the range that can be computed.
        """
        self._act_from_outside()
        with self._stable():
            self._control_step(action)

    @contextmanager
    def _stable(self) -> Iterator[None]:
        """Turn numerical errors of the simulation into a ``RejectedError``.

        Raises:
            RejectedError: ``simulation_unstable`` if numbers grow beyond the range that can be computed.
        """
        try:
            yield
        except (np.linalg.LinAlgError, mujoco.FatalError) as error:
            raise RejectedError("simulation_unstable") from error
        # After too large accelerations, MuJoCo resumes from the model's own pose and raises nothing.
        if data_of(self.sim).warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise RejectedError("simulation_unstable")

    def _act_from_outside(self) -> None:
        """Begin or end the scene's push, and count the step that follows."""
        if self._push is not None:
            acts = self._push.first_step <= self._steps < self._push.first_step + self._push.steps
            data_of(self.sim).body(self._push.body).xfrc_applied[:] = self._push.wrench if acts else 0.0
        self._steps += 1

    @property
    def sim(self) -> Any:
        """Return robosuite's ``MjSim`` of the last restored scene, to read from; a later ``restore`` may replace it.

        Its textures are plain: render from the scene's MJCF instead. Changes to its model remain if the same scene is
        restored again.
        """
        return self._env.sim

    @property
    def hand(self) -> tuple[Floats, Rotation]:
        """Return position (3,) in m and orientation of the grip site, in the world's frame."""
        grip = grip_pose(data_of(self.sim))
        return grip.position_m, Rotation.from_matrix(grip.rotation)

    def pose(self, name: str) -> Floats:
        """Return the pose (7,), position in m and rotation wxyz, of an object, a fixture or a region.

        Args:
            name: the thing's name in the BDDL file.
        """
        data = data_of(self.sim)
        joint = f"{name}_joint0"
        if joint in self.sim.model.joint_names:
            return np.array(data.joint(joint).qpos)
        return fixed_pose(data, name)

    @property
    def state(self) -> Floats:
        """Return the flattened MuJoCo state (S,): time, qpos, qvel."""
        return np.asarray(self._env.get_sim_state(), np.float64)

    @property
    def site_alpha(self) -> NDArray[np.float32]:
        """Return the opacity of each site, (nsite,); LIBERO lights a stove's burner by showing its site."""
        return np.array(self._env.sim.model.site_rgba[:, 3], np.float32)

    def succeeded(self) -> bool:
        """Return LIBERO's success check, the conjunction of the goal's predicates."""
        return self.satisfies(self._goal) if self._goal else bool(self._env.check_success())

    def satisfies(self, goal: Iterable[Sequence[str]]) -> bool:
        """Return whether all facts of a goal hold, such as the goal of another task in the same scene."""
        from libero.libero.envs.predicates import eval_predicate_fn

        states = self._env.env.object_states_dict
        return all(eval_predicate_fn(predicate, *(states[name] for name in names)) for predicate, *names in goal)

    def close(self) -> None:
        self._env.close()


@lru_cache(maxsize=1)
def environment_of(task: Task) -> Environment:
    """Return this process's environment for ``task``; restore a scene before you step it."""
    return Environment(task)
