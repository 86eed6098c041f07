"""LIBERO's own environment for one task, without rendering: the physics, the controller and the goal's predicates."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RefusedError
from pipeline.libero.assets import as_evaluated
from pipeline.physics.control_env import control_env, seeded, until_placed
from pipeline.physics.stepping import ControlStep
from pipeline.scenes.compiled import fixed_pose, physics_to_read
from pipeline.scenes.swept_path import SURFACES
from pipeline.types import Floats, Push, Scene, Task

DUMMY_ACTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
"""(7,) what is done while a scene settles: nothing, with the gripper open (OpenVLA's and LIBERO-Plus's rule)."""


class UnusableSceneError(PipelineError):
    """A scene or a state that cannot be simulated: ``scene_refused`` or ``state_mismatch``, as the manifest says it."""

    def __init__(self, reason: str, what: str, task: Task):
        super().__init__(
            what,
            where=str(task),
            expected="the scene of this task, and time, qpos and qvel of the same model",
            remedy="use demonstrations recorded with this LIBERO version, or ones that carry their model_file",
        )
        self.reason = reason


class Environment:
    """One task's environment; every ``restore`` forgets what happened before it.

    Building one takes 1 to 3 s, so keep an environment for all demonstrations of its task.

    Args:
        scene_properties: ``floor_style`` and ``wall_style``, where they are not those of the task's arena.
        scene_xml: absolute path of another file for the arena.
    """

    def __init__(self, task: Task, scene_properties: Mapping[str, str] | None = None, scene_xml: str | None = None):
        self.task = task
        unseen = dict.fromkeys(("has_renderer", "has_offscreen_renderer", "use_camera_obs"), False)
        arena = {"scene_properties": scene_properties, "scene_xml": scene_xml}
        build = partial(control_env(), bddl_file_name=str(task.bddl_file), ignore_done=True, **unseen, **arena)
        with seeded(0):
            self._env = until_placed(build, task)
        self._control_step = ControlStep(self._env.env)
        self._openings = len(self._env.env.object_property_initializers)
        self._placed: dict[int, str] = {}
        self._scene: str | None = None
        self._push: Push | None = None
        self._steps = 0

    def place_fixtures(self, seed: int) -> str:
        """The scene as LIBERO's own first reset makes it under ``seed``, as MJCF; 1.3 s, the second time nothing.

        For demonstrations whose source did not record the scene: movable objects are put where the recorded state
        says, but fixtures (cabinet, stove, rack, microwave) are not part of it and stay where the reset put them.
        """
        if seed not in self._placed:
            self._reset_under(seed)
            self._placed[seed] = self._as_mjcf()
        return self._placed[seed]

    def reset(self, seed: int) -> str:
        """The scene of LIBERO's own first reset under ``seed``, as MJCF, as of its initial states; 1.3 s.

        Fixtures and objects stand where ``place_fixtures`` and the BDDL file have them, and the arm at home with
        robosuite's default noise, which LIBERO's ``ControlEnv`` leaves out. The environment stays there.
        """
        self._reset_under(seed, initialization_noise="default")
        return self._as_mjcf()

    def _reset_under(self, seed: int, **robot: object) -> None:
        """Reset by LIBERO's own draws under a seed, with other settings of robosuite's robot than usual."""
        env = self._env.env
        # Each reset adds its samplers of open drawers and doors to those of all resets before, and draws from every
        # one of them: without this, the second placement under a seed differs from the first.
        del env.object_property_initializers[self._openings :]
        self._scene = None
        usual = env.robot_configs[0]  # each reset makes the robot anew from this
        env.robot_configs[0] = {**usual, **robot}
        try:
            with seeded(seed):
                until_placed(env.reset, self.task)
        finally:
            env.robot_configs[0] = usual
        self._control_step = ControlStep(env)

    def _as_mjcf(self) -> str:
        """The scene that LIBERO's last reset compiled, with the masses of an evaluation."""
        scene = ET.fromstring(self._env.sim.model.get_xml())
        as_evaluated(scene)
        return ET.tostring(scene, encoding="unicode")

    def restore(self, scene: Scene) -> None:
        """Put the environment where a scene starts; nothing from before has an effect on what follows.

        A scene is compiled in 0.2 to 0.4 s; restoring the last one again takes 10 ms.

        Raises:
            UnusableSceneError: when MuJoCo or LIBERO refuses the scene, or the state is not of its model.
        """
        env = self._env.env
        if scene.model_xml != self._scene:
            self._scene = None
            try:
                self._open(scene.model_xml)
            except (ValueError, KeyError, mujoco.FatalError) as error:
                # What MuJoCo raises when it compiles, and robosuite when a name that it looks up is not in the model.
                what = f"the scene is refused ({error!s:.300})"
                raise UnusableSceneError("scene_refused", what, self.task) from error
            self._check_names()
            self._scene, self._site_rgba = scene.model_xml, env.sim.model.site_rgba.copy()
        else:
            # The part of the model that LIBERO changes while it steps: the site that shows a lit burner.
            env.sim.model.site_rgba[:] = self._site_rgba
            self._reset_in_place()
        robot = env.robots[0]
        # Of both fingers; robosuite's gripper survives the reset with its last command.
        robot.gripper.current_action = scene.gripper * np.array([-1.0, 1.0])
        env.sim.reset()
        self._check_state(scene.state)
        env.sim.set_state_from_flattened(scene.state)
        if scene.posture_rad is not None:
            env.sim.data.qpos[robot._ref_joint_pos_indexes] = scene.posture_rad
            env.sim.data.qvel[robot._ref_joint_vel_indexes] = 0.0
        env.sim.forward()
        # As after a reset in an evaluation: the controller knows where the arm is, and its null space pulls the arm to
        # the posture that it is in, not to robosuite's home posture.
        robot.controller.update_initial_joints(env.sim.data.qpos[robot._ref_joint_pos_indexes])
        if scene.posture_rad is not None:
            # As where LIBERO-Plus puts an initial state in after a reset with another posture: until the end of its
            # first substep, the controller takes the arm to be there still.
            env.sim.set_state_from_flattened(scene.state)
            env.sim.forward()
        env._post_process()
        self._control_step = ControlStep(env)
        self._push, self._steps = scene.push, 0

    def settle(self, steps: int) -> None:
        """Do nothing for some control steps, with the gripper open, while arm and objects come to rest; as ``step``."""
        # Before the first look, from which a push counts.
        self._steps = -steps
        for _ in range(steps):
            self.step(DUMMY_ACTION)

    def _open(self, model_xml: str) -> None:
        """As robosuite's ``reset_from_xml_string``, but a scene that was compiled lately is not compiled again."""
        from robosuite.utils.binding_utils import MjSim

        env, model = self._env.env, copy.copy(physics_to_read(model_xml))
        env.close()
        env.sim = MjSim(model)
        env.sim.forward()
        env.initialize_time(env.control_freq)
        self._reset_in_place()

    def _reset_in_place(self) -> None:
        """LIBERO's reset of the scene that is there, which otherwise would draw one anew."""
        self._env.env.deterministic_reset = True
        try:
            self._env.env.reset()
        finally:
            self._env.env.deterministic_reset = False

    def _check_names(self) -> None:
        """What is looked up by name later, besides what LIBERO's own reset has looked up already."""
        env, model = self._env.env, self._env.env.sim.model
        needed = {view.camera: model.camera_names for view in SCHEMA.views.values()}
        needed |= {joint: model.joint_names for thing in env.objects_dict.values() for joint in thing.joints}
        missing = [name for name, names in needed.items() if name not in names]
        if not set(SURFACES) & set(model.body_names):
            missing.append(" or ".join(SURFACES))
        if missing:
            raise UnusableSceneError("scene_refused", f"the scene has no {', '.join(missing)}", self.task)

    def _check_state(self, state: Floats) -> None:
        model = self.sim.model._model
        expected = 1 + model.nq + model.nv
        if len(state) != expected:
            what = f"the recorded state has {len(state)} numbers, the scene's has {expected}"
            raise UnusableSceneError("state_mismatch", what, self.task)
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        turns = state[4 + model.jnt_qposadr[free, None] + np.arange(4)]
        for joint in free[~turns.any(axis=1)]:
            what = f"the recorded state gives {model.joint(joint).name} a rotation of length 0"
            raise UnusableSceneError("state_mismatch", what, self.task)

    def step(self, action: Floats) -> None:
        """Run one control step (50 ms) with an OSC_POSE action (7,) in [-1, 1].

        Raises:
            RefusedError: ``simulation_unstable`` when the numbers grow beyond what can be computed with.
        """
        self._act_from_outside()
        with self._stable():
            self._control_step(action)

    @contextmanager
    def _stable(self) -> Iterator[None]:
        """Raises: RefusedError: ``simulation_unstable`` when numbers grow beyond what can be computed with."""
        try:
            yield
        except (np.linalg.LinAlgError, mujoco.FatalError) as error:
            raise RefusedError("simulation_unstable") from error
        # MuJoCo then goes on from the model's own pose, and raises nothing.
        if self.sim.data._data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise RefusedError("simulation_unstable")

    def _act_from_outside(self) -> None:
        """Begin or end the scene's push, and count the step that follows."""
        if self._push is not None:
            acts = self._push.first_step <= self._steps < self._push.first_step + self._push.steps
            self.sim.data._data.body(self._push.body).xfrc_applied[:] = self._push.wrench if acts else 0.0
        self._steps += 1

    @property
    def sim(self) -> Any:
        """robosuite's ``MjSim`` of the scene restored last, to read from; a later ``restore`` may replace it.

        Its textures are plain: render from the scene's MJCF instead. What is written into its model stays there when
        the same scene is restored again.
        """
        return self._env.sim

    @property
    def hand(self) -> tuple[Floats, Rotation]:
        """Position (3,) in m and orientation of the grip site, in the world's frame."""
        data = self.sim.data._data
        grip = data.site("gripper0_grip_site")
        return grip.xpos.copy(), Rotation.from_matrix(grip.xmat.reshape(3, 3))

    def pose(self, name: str) -> Floats:
        """(7,) position in m and rotation wxyz of an object, a fixture or a region, by its name in the BDDL file."""
        data = self.sim.data._data
        joint = f"{name}_joint0"
        return np.array(data.joint(joint).qpos) if joint in self.sim.model.joint_names else fixed_pose(data, name)

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

    def satisfies(self, goal: Iterable[Sequence[str]]) -> bool:
        """Whether all facts of a goal hold, such as that of another task in the same scene."""
        return all(self._env.env._eval_predicate(list(fact)) for fact in goal)

    def close(self) -> None:
        self._env.close()


@lru_cache(maxsize=1)
def shared(task: Task) -> Environment:
    """This process's environment for ``task``, for whoever restores it before stepping."""
    return Environment(task)
