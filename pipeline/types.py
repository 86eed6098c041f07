"""The nouns of the pipeline, in the order in which data meets them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict

if TYPE_CHECKING:
    import mujoco

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]
"""(H, W, 3) RGB."""
RenderedExtra = Literal["depth", "segmentation", "object_poses"]
"""What the render stage makes beside the frames when it is asked to."""
Extra = Literal[RenderedExtra, "outcome"]
"""What a dataset has beside the frames; ``outcome``, that of failures says of each episode why it is one."""


class Frozen(BaseModel):
    """A record that cannot change and refuses fields it does not know, and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Place = Annotated[Path, AfterValidator(Path.expanduser)]
"""A path of a configuration; ``~`` is the home folder, as in a shell."""


class State(NamedTuple):
    """A flattened MuJoCo state (S,), taken apart.

    Attributes:
        time: in s.
        qpos: (nq,) positions and rotations of the joints.
        qvel: (nv,) their velocities.
    """

    time: float
    qpos: Floats
    qvel: Floats

    @classmethod
    def of(cls, flat: Floats, nq: int) -> State:
        """The parts of a state (S,); what is written into them is written into it."""
        return cls(flat[0], flat[1 : 1 + nq], flat[1 + nq :])

    @property
    def flat(self) -> Floats:
        return np.concatenate([[self.time], self.qpos, self.qvel])

    def put_into(self, data: mujoco.MjData) -> None:
        """Nothing that follows from it is computed."""
        data.time, data.qpos[:], data.qvel[:] = self


@dataclass(frozen=True)
class Task:
    """One LIBERO task.

    Attributes:
        suite: ``libero_spatial``, ``libero_object``, ``libero_goal`` or ``libero_10``.
        name: LIBERO's task name, the stem of its BDDL file.
        instruction: the wording of LIBERO's task list, as policies are prompted with it.
        bddl_file: where the scene and the goal are defined.
    """

    suite: str
    name: str
    instruction: str
    bddl_file: Path

    def __str__(self) -> str:
        return f"{self.suite}/{self.name}"


@dataclass(frozen=True)
class Demo:
    """One recorded human demonstration.

    Attributes:
        key: its name in its source, such as ``demo_0``.
        source: where it came from, for provenance (never parsed).
        origin: who made it, ``human``, or ``expanded`` when it was made from a human one.
        sha256: hash of the recorded content (actions, states, model), 64 hex digits.
        actions: (T, 7) OSC_POSE deltas in [-1, 1] and gripper (-1 open, +1 close), 20 Hz.
        init_state: (S,) flattened MuJoCo state before the first action: time, qpos, qvel.
        states: (T, S) the same before each action, or None when the source recorded only the first.
        model_xml: MJCF of the recorded scene with asset paths of this machine, or None when the source did
            not record it (then fixtures are placed by LIBERO's own reset under a fixed seed).
        perturbations: JSON of what an expansion changed; an empty list if nothing.
        expanded_from_sha256: ``sha256`` of the human demonstration that it was made from; None for a human one.
    """

    task: Task
    key: str
    source: str
    origin: str
    sha256: str
    actions: Floats
    init_state: Floats
    states: Floats | None
    model_xml: str | None
    perturbations: str = "[]"
    expanded_from_sha256: str | None = None

    @property
    def demo_id(self) -> str:
        return f"{self.task}/{self.key}"


class Push(NamedTuple):
    """An external force in the course of an episode.

    Attributes:
        body: of MuJoCo's model, on whose centre of mass it acts (``mj_data.xfrc_applied``).
        wrench: (6,) force in N and torque in N m along the world's axes.
        first_step: executed actions before it, since the first look.
        steps: control steps that it lasts.
    """

    body: str
    wrench: tuple[float, float, float, float, float, float]
    first_step: int
    steps: int


@dataclass(frozen=True)
class Scene:
    """Where a replay starts.

    Attributes:
        model_xml: MJCF with asset paths of this machine.
        state: (S,) flattened MuJoCo state: time, qpos, qvel.
        resolved: axis to what its perturbation came to in this scene, JSON-serialisable, such as where objects ended.
        gripper: where the gripper's command stands: -1 open, 1 closed, 0 as after LIBERO's reset. The next action is
            added to it, so it takes four control steps from 0 to -1.
        posture_rad: (7,) joint angles of the reset that came before the state was put in. To these the controller's
            null space pulls the arm, and it keeps their orientation of the hand until an action turns that. None where
            it holds the arm as the state has it.
        push: what pushes the robot in the course of the episode, whatever is done meanwhile.
    """

    model_xml: str
    state: Floats
    resolved: Mapping[str, Any] = field(default_factory=dict)
    gripper: float = 0.0
    posture_rad: tuple[float, ...] | None = None
    push: Push | None = None


RollOut = Callable[[Scene, Demo], Floats]
"""(K+1, S) states that a demonstration's actions lead through from a scene."""


@dataclass(frozen=True)
class Verdict:
    """Whether something planned is kept.

    Attributes:
        reason: ``kept``, or a short reason in snake_case, such as ``goal_not_reached``.
    """

    kept: bool
    reason: str


@dataclass(frozen=True)
class Quality:
    """How well a trajectory was moved (``physics/quality.py``): columns of the manifest, with what they mean.

    Another object is one that the goal does not name, and that stands on or in nothing that the goal moves.
    """

    non_target_moved_m: Annotated[float, "largest displacement of another object at any step, from the first look"]
    non_target_left_m: Annotated[float, "largest displacement of another object after the last step"]
    touched_steps: Annotated[int, "steps after which the robot touches something else than the things of the goal"]
    path_m: Annotated[float, "length of the end effector's path"]
    jerk_rms_m_s3: Annotated[float, "root mean square of the end effector's jerk, by third differences at 20 Hz"]
    idle_share: Annotated[float, "share of steps in which hand and fingers move less than 0.5 mm and 0.25 degrees"]
    joint_margin_rad: Annotated[float, "smallest distance of a joint of the arm to its limit; below 0 where it yields"]
    lag_m: Annotated[float, "largest distance between where an action asks the hand to be and where the step takes it"]


@dataclass(frozen=True)
class Trajectory:
    """What physics did: no pixels.

    Attributes:
        trajectory_id: hash of everything that determines it.
        mode: how its actions came about, ``open_loop`` or ``tracked``.
        scene: where it started, before the arm and the objects settled; asset paths of this machine.
        states: (K+1, S) flattened states: before each executed action, and after the last. The first is the first look.
        actions: (K, 7) executed actions.
        site_alpha: (K+1, nsite) opacity of the model's sites; LIBERO shows a lit burner through one.
        verdict: the judge's word after the last action.
        quality: how well it was moved; None where nothing was executed, or nobody measured.
    """

    trajectory_id: str
    mode: str
    scene: Scene
    states: Floats
    actions: Floats
    site_alpha: NDArray[np.float32]
    verdict: Verdict
    quality: Quality | None = None

    @property
    def model_xml(self) -> str:
        return self.scene.model_xml

    @property
    def resolved(self) -> str:
        """JSON of what physics perturbations came to, by axis; or under ``fault`` why it could not be simulated."""
        return json.dumps(self.scene.resolved, sort_keys=True)


@dataclass(frozen=True)
class Geometry:
    """Where a view is seen from, and what it sees beside colours; conventions are those of ``schemas/episode.json``.

    Attributes:
        intrinsics: (3, 3) float32, camera to pixels of the stored frame.
        extrinsics: (4, 4) float32, camera to the frame that the view is seen from: the world, or the end effector.
        maps: ``depth`` and ``segmentation``, where they were asked for, to T PNG files, turned like the frames.
    """

    intrinsics: NDArray[np.float32]
    extrinsics: NDArray[np.float32]
    maps: Mapping[Extra, Sequence[bytes]] = field(default_factory=dict)


@dataclass(frozen=True)
class Rendered:
    """Everything that a policy may see of one trajectory.

    Attributes:
        replay_mode: how the trajectory's actions came about.
        state: (K, 8), joint_state: (K, 7), action: (K, 7); see ``schemas/episode.json``.
        streams: stream id to K encoded frames.
        rejected: stream id to the reason why it was not rendered.
        geometry: id of a stream's geometry to what it is.
        object_poses: (K, 24, 7) float32, None where they were not asked for.
        instances: names of the things that segmentation and poses number; none without those.
        quality: the trajectory's.
    """

    replay_mode: str
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    action: NDArray[np.float32]
    streams: Mapping[str, Sequence[bytes]] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    geometry: Mapping[str, Geometry] = field(default_factory=dict)
    object_poses: NDArray[np.float32] | None = None
    instances: Sequence[str] = ()
    quality: Quality | None = None


class Subtask(NamedTuple):
    """What is being done, in plain words, from the moment before the action ``step`` on."""

    step: int
    text: str


@dataclass(frozen=True)
class Episode:
    """What a policy sees, ready for the writers; names, units and signs are those of ``schemas/episode.json``.

    Attributes:
        episode_id: identity by content, joins RLDS, LeRobot and manifest.
        frames: view name (``image``, ``wrist_image``) to T JPEG files, already rotated.
        state, joint_state, action: (T, 8), (T, 7) and (T, 7) float32.
        instruction: the text the policy is prompted with.
        provenance: the columns named in ``schemas/episode.json``.
        geometry: view name to where it is seen from.
        object_poses, instances: as in ``Rendered``.
        rewrites: other wordings of its task, for training; none where they were not asked for.
        subtasks: what is done one after the other; none where they were not asked for.
    """

    episode_id: str
    frames: Mapping[str, Sequence[bytes]]
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    action: NDArray[np.float32]
    instruction: str
    provenance: Mapping[str, str | int | float]
    geometry: Mapping[str, Geometry]
    object_poses: NDArray[np.float32] | None = None
    instances: Sequence[str] = ()
    rewrites: Sequence[str] = ()
    subtasks: Sequence[Subtask] = ()

    def __len__(self) -> int:
        return len(self.action)
