"""Simulator of one task for the evaluation of policies, reused between episodes, and the renderer of its scenes."""

import atexit
import ctypes
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import Perturbation
from pipeline.libero.starts import SETTLING_STEPS
from pipeline.machine_code import fixed_machine_code
from pipeline.physics.control_env import control_env
from pipeline.physics.environment import Environment
from pipeline.physics.robosuite_1_4 import copy_controller, data_of, finish_action, model_of, restore_controller
from pipeline.physics.stepping import ControlStep
from pipeline.planning.streams import Stream
from pipeline.rendering.render import frames_of
from pipeline.rendering.renderer import LastScene
from pipeline.scenes.compiled import ARM, FINGERS, proprioception
from pipeline.testset.definitions import SceneFiles
from pipeline.types import Floats, Frame, Scene, Task

OBSERVED = 24
"""Number of the substep, among the 25 of a control step, that robosuite 1.4.0 observes.

An observable samples once per 50 ms, by a timer that counts every update. A reset and LIBERO's ``set_init_state`` force
one update each, so the timer is two substeps ahead. Therefore the 24th substep is observed, not the last. The
policy sees a state of the arm that is 2 to 4 ms old. Source: ``Observable.update`` in
``robosuite/utils/observables.py``. In a test, an ``Observable`` that was updated twice observed the 24th substep in
each of 20,000 control steps.
"""

_PHYSICS = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Observed(NamedTuple):
    """Simulator values of LIBERO's observation of one control step.

    Attributes:
        qpos: (nq,) positions in the frames.
        site_alpha: (nsite,) opacity of each site in the frames.
        state: (8,) float32 position (m) and axis-angle (rad) of the end effector and two finger joints (m).
        joint_state: (7,) float32 joint angles in rad.
        hand_wxyz: (4,) orientation of the hand, which ``state`` has as an axis-angle.
        velocity: (9,) velocities of the joints (rad/s) and of the two finger joints (m/s).
    """

    qpos: Floats
    site_alpha: NDArray[np.float32]
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    hand_wxyz: Floats
    velocity: Floats


class _Rewind(NamedTuple):
    """Result of a reset, as far as episodes change it; ``physics`` includes the start values of the solver."""

    seed: int
    posture_rad: tuple[float, ...] | None
    physics: Floats
    site_rgba: NDArray[np.float32]
    controller: dict[str, Any]


class Simulator(Environment):
    """Environment in which an episode starts from a reset or from a scene, and then settles.

    LIBERO's own reset compiles the model, so states and frames equal those of LIBERO's evaluation. A model that is read
    from MJCF would differ. A reset takes 1.3 s; episodes with equal seed and posture share a reset.

    Args:
        files: files of the arena, by absolute paths; the task's own by default.

    Raises:
        PipelineError: when NumPy does not compute with the fixed machine code.
    """

    def __init__(self, task: Task, files: SceneFiles | None = None):
        fixed_machine_code()
        styles, scene_xml = None, None
        if files is not None:
            styles, scene_xml = _styles({"floor": files.floor, "wall": files.wall}), files.scene_xml
        super().__init__(task, styles, scene_xml, has_images=True)
        self._rewind: _Rewind | None = None

    @property
    def model(self) -> mujoco.MjModel:
        """Return the model that LIBERO's last reset compiled, including textures."""
        return model_of(self._env.sim)

    @property
    def controller(self) -> Any:
        """Return robosuite's controller of the arm."""
        return self._env.env.robots[0].controller

    def start(
        self,
        seed: int,
        state: Floats,
        posture_rad: tuple[float, ...] | None = None,
        settling_steps: int = SETTLING_STEPS,
    ) -> None:
        """Reset, set an initial state and settle, as in the benchmarks' evaluations.

        Args:
            seed: seed of numpy's global generator during LIBERO's reset. The reset places the fixtures, which are not
                part of the state.
            state: (S,) flattened MuJoCo state: time, qpos, qvel.
            posture_rad: (7,) joint angles of the arm in the reset; LIBERO's own by default. The state moves the arm
                at once. But the controller keeps the goal orientation and the null-space posture of the reset, and
                drives the arm to them.
            settling_steps: number of control steps before the first observation.
        """
        env = self._env.env
        self._push = None
        saved = self._rewind
        if saved is None or (seed, posture_rad) != (saved.seed, saved.posture_rad):
            self._reset(seed, posture_rad)
        else:
            mujoco.mj_resetData(self.model, data_of(env.sim))
            mujoco.mj_setState(self.model, data_of(env.sim), saved.physics, _PHYSICS)
            env.sim.model.site_rgba[:] = saved.site_rgba
            restore_controller(self.controller, saved.controller)
        env.robots[0].gripper.current_action = np.zeros(env.robots[0].gripper.dof)
        self._check_state(state)
        env.sim.set_state_from_flattened(state)
        env.sim.forward()
        finish_action(env)
        self._observe_from_here()
        self.settle(settling_steps)

    def start_scene(self, scene: Scene) -> None:
        """Restore a scene that does not come from LIBERO's reset, such as a perturbed scene, and settle."""
        self._rewind = None
        self.restore(scene)
        self._observe_from_here()
        self.settle(SETTLING_STEPS)

    def state_of_reset(self, seed: int) -> Floats:
        """Return the state (S,) of a reset under a seed, as LIBERO's initial states: objects in the task's regions.

        The reset that ``start`` kept is discarded.
        """
        self._rewind = None
        self.reset(seed)
        return self.state

    def place_fixtures(self, seed: int) -> str:
        """Place the fixtures, see ``Environment``, and discard the reset that ``start`` kept."""
        self._rewind = None
        return super().place_fixtures(seed)

    def _reset(self, seed: int, posture_rad: tuple[float, ...] | None) -> None:
        """Reset LIBERO's environment, and keep the result for later episodes."""
        env = self._env.env
        self._reset_under(seed, initial_qpos=None if posture_rad is None else np.array(posture_rad))
        physics = np.empty(mujoco.mj_stateSize(self.model, _PHYSICS))
        mujoco.mj_getState(self.model, data_of(env.sim), physics, _PHYSICS)
        site_rgba, controller = env.sim.model.site_rgba.copy(), copy_controller(self.controller)
        self._rewind = _Rewind(seed, posture_rad, physics, site_rgba, controller)

    def _observe_from_here(self) -> None:
        """Begin a new control step at the current state, and observe this state."""
        env = self._env.env
        self._control_step = ControlStep(env)
        self.observed = self._observe(env.sim.data.qpos.copy())

    def step(self, action: Floats, absolute: bool = False) -> None:
        """Run one control step (50 ms), and store LIBERO's observation of it in ``observed``.

        Args:
            action: (7,) deltas and gripper, or the controller's goal and gripper.
            absolute: true if the action is a goal.

        Raises:
            RejectedError: ``simulation_unstable`` if numbers grow too large to compute with, and if MuJoCo has reset
                the scene because of such numbers.
        """
        data = data_of(self._env.sim)
        qpos = data.qpos.copy()
        self.controller.use_delta = not absolute
        self._act_from_outside()
        with self._stable():
            for number, _ in enumerate(self._control_step.substeps(action), start=1):
                if number == OBSERVED:
                    self.observed = self._observe(qpos)
                qpos = data.qpos.copy()

    def _observe(self, qpos: Floats) -> Observed:
        """Return the observation of the current geometry.

        Args:
            qpos: (nq,) positions from which the data's geometry was computed, one substep before the data's own.
        """
        data, names = data_of(self._env.sim), (*ARM, *FINGERS)
        velocity = np.concatenate([data.joint(name).qvel for name in names])
        hand_wxyz = data.body("robot0_right_hand").xquat.copy()
        return Observed(qpos, self.site_alpha, *proprioception(data), hand_wxyz, velocity)


def _styles(images: Mapping[str, str]) -> dict[str, str]:
    """Register images with LIBERO, and return the ``scene_properties`` that select them.

    LIBERO searches an image in the folder of the arena's image that it replaces. LIBERO finds images by style names and
    has no style name for some images, so each image gets a name.
    """
    control_env()  # imports LIBERO in the right way
    from libero.libero.envs.arenas.style import STYLE_MAPPING

    for part, image in images.items():
        STYLE_MAPPING[part][image] = Path(image).name
    return {f"{part}_style": image for part, image in images.items()}


class Picture:
    """Renderer of one scene after the other; episodes with equal meshes and textures share an OpenGL context."""

    def __init__(self) -> None:
        self._opened = LastScene()
        self._scene: mujoco.MjModel | str = ""
        self._perturbations: Sequence[Perturbation] = ()
        self._changes: ExitStack | None = None

    @property
    def opened(self) -> LastScene:
        """Return the renderer; call ``restore`` before another scene is rendered with it."""
        return self._opened

    def show(self, scene: mujoco.MjModel | str, perturbations: Sequence[Perturbation]) -> None:
        """Set the scene and the perturbations that ``frame`` renders.

        Args:
            scene: a model, or the scene's MJCF if the model has no textures.
        """
        self.restore()
        self._scene, self._perturbations = scene, perturbations

    def frame(self, view: str, observed: Observed, step: int) -> Frame:
        """Render a (256, 256, 3) uint8 RGB image, turned by 180 degrees.

        Args:
            view: name of the view in ``schemas/episode.json``.
            step: number of steps taken, for random noise.
        """
        renderer, stream = self._opened.renderer(self._scene), Stream(view, tuple(self._perturbations))
        if self._changes is None:
            self._changes = ExitStack()
            self._changes.enter_context(renderer.perturbed(stream.changes))
        state = np.concatenate([[0.0], observed.qpos, np.zeros(renderer.model.nv)])
        return frames_of(renderer, state, observed.site_alpha, [stream], step)[0]

    def restore(self) -> None:
        """Undo an episode's render perturbations."""
        if self._changes is not None:
            self._changes.close()
        self._changes = None

    def close(self) -> None:
        """Close the renderer."""
        self.show("", ())
        self._opened.close()


def close_at_exit(close: Callable[[], None]) -> None:
    """Arrange the end of an environment that this thread uses until the process ends.

    Only the thread that rendered may free a renderer, because an OpenGL context belongs to one thread.

    * The main thread still runs when Python exits. It calls ``close`` then, before OpenGL ends.
    * A thread of a worker process is gone by then. The environment must never be freed: Python would free it on
      another thread. The operating system frees its memory with the process.

    Args:
        close: method of the environment that closes it; it keeps the environment alive.
    """
    if threading.current_thread() is threading.main_thread():
        # Python calls exit handlers in reverse order. The first OpenGL context registers a handler that ends OpenGL, so
        # the context is created before ``close`` is registered.
        gl.prepare()
        mujoco.gl_context.GLContext(1, 1).free()
        atexit.register(close)
    else:
        # A reference that nobody releases; a module's variable would be cleared when Python exits.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(close))
