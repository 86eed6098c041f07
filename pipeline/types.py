"""Data types of the pipeline, in the order of the data flow."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, NewType

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from pipeline.field_docs import field_docs, summary

if TYPE_CHECKING:
    import mujoco

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]
"""(H, W, 3) RGB."""
Jpeg = NewType("Jpeg", bytes)
"""Content of a JPEG file: an encoded frame, as every dataset carries it."""
RenderedExtra = Literal["depth", "segmentation", "object_poses", "boxes"]
"""Optional output of the render stage in addition to frames."""
Extra = Literal[RenderedExtra, "outcome"]
"""Optional content of a dataset in addition to frames; ``outcome`` states why each episode of a failures set failed."""


class Frozen(BaseModel):
    """An immutable record that rejects unknown fields and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema with a description of each field, which editors show."""
        schema = handler(core)
        described = handler.resolve_ref_schema(schema)
        described["description"] = summary(cls)
        documented = field_docs(cls)
        for name, properties in described.get("properties", {}).items():
            if name in documented:
                properties["description"] = documented[name]
        return schema


def _reject_truth(value: Any) -> Any:
    """Reject ``true`` and ``false``, which pydantic reads as 1 and 0.

    Raises:
        ValueError: if the value is one of them.
    """
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


NO_TRUTH = BeforeValidator(_reject_truth)
"""Annotation of a number that rejects ``true`` and ``false``."""

Count = Annotated[int, Field(ge=1, le=1_000_000), NO_TRUTH]
"""A number of files or episodes. Numbers above the limit would fill the memory before any message appears."""

LONGEST_NAME = 60
"""Largest length of a name in paths. A path may join several names; file systems limit a name to 255 bytes."""


def _expand_home(path: Path) -> Path:
    """Replace ``~`` by the home folder.

    Raises:
        ValueError: if the system knows no home folder of the user.
    """
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError("the home folder of ~ is unknown here; write the whole path") from error


def find_home() -> Path | None:
    """Return the home folder; `None` if the system knows none, as in a container with an unnamed user."""
    try:
        return Path.home()
    except RuntimeError:
        return None


Place = Annotated[Path, AfterValidator(_expand_home)]
"""A path of a configuration; ``~`` is the home folder, as in a shell."""


class State(NamedTuple):
    """The parts of a flattened MuJoCo state (S,).

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
        """Return the parts of a state (S,) as views: writing into ``qpos`` or ``qvel`` changes the state."""
        return cls(flat[0], flat[1 : 1 + nq], flat[1 + nq :])

    @property
    def flat(self) -> Floats:
        return np.concatenate([[self.time], self.qpos, self.qvel])

    def put_into(self, data: mujoco.MjData) -> None:
        """Copy the state into MuJoCo's data, without computing the quantities that follow from it."""
        data.time, data.qpos[:], data.qvel[:] = self


@dataclass(frozen=True)
class Task:
    """One task of LIBERO or of the user.

    Attributes:
        suite: one of LIBERO's five suites, or a suite of the user.
        name: LIBERO's task name, the stem of its BDDL file.
        instruction: the wording of LIBERO's task list, with which policies are prompted.
        bddl_file: the file that defines the scene and the goal.
        goal_file: another file that defines the goal, of a task that is carried to the scene of ``bddl_file``
            (``pipeline.libero.carried``); ``None`` for all tasks of LIBERO and of the user.
    """

    suite: str
    name: str
    instruction: str
    bddl_file: Path
    goal_file: Path | None = None

    def __str__(self) -> str:
        return f"{self.suite}/{self.name}"


@dataclass(frozen=True)
class Demo:
    """One demonstration: recorded, expanded from another one, or from a program.

    Attributes:
        key: its name in its source, such as ``demo_0``.
        source: its source, for provenance (never parsed).
        origin: ``human``, or ``expanded`` if it was generated from a human demonstration.
        sha256: hash of the recorded content (actions, states, model), 64 hex digits.
        actions: (T, 7) OSC_POSE deltas in [-1, 1] and gripper (-1 open, +1 close), 20 Hz.
        init_state: (S,) flattened MuJoCo state before the first action: time, qpos, qvel.
        states: (T, S) flattened MuJoCo states before each action, or ``None`` when the source recorded only the first.
        model_xml: MJCF of the recorded scene with asset paths of this machine, or ``None`` when the source did not
            record it. LIBERO's own reset under a fixed seed then places the fixtures.
        perturbations: JSON list of the changes of an expansion; an empty list without changes.
        expanded_from_sha256: ``sha256`` of the human demonstration behind an expansion; ``None`` for a human one.
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
    """An external force during an episode.

    Attributes:
        body: body of MuJoCo's model; the force acts on its centre of mass (``mj_data.xfrc_applied``).
        wrench: (6,) force in N and torque in N m along the world's axes.
        first_step: number of executed actions between the first observation and the push.
        steps: duration in control steps.
    """

    body: str
    wrench: tuple[float, float, float, float, float, float]
    first_step: int
    steps: int


@dataclass(frozen=True)
class Start:
    """Conditions of a replay's start that are not part of a MuJoCo state.

    Every store and dataset contains all fields, by ``to_json`` and ``of``.

    Attributes:
        gripper: current gripper command: -1 open, 1 closed, 0 as after LIBERO's reset. The next action is added to it,
            so the change from 0 to -1 takes four control steps.
        posture_rad: (7,) joint angles of the reset that came before the state was set. The controller's null space
            pulls the arm to these angles. The controller keeps their orientation of the hand until an action turns it.
            ``None`` if the controller holds the arm as in the state.
        push: force on the robot during the episode, independent of the actions.
    """

    gripper: float
    posture_rad: tuple[float, ...] | None = None
    push: Push | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the JSON-serialisable values of the fields.

        Gripper and posture are always present. Other fields are present if they differ from their default, so files
        without them keep the bytes of versions without these fields.
        """
        always = {"gripper": self.gripper, "posture_rad": self.posture_rad}
        changed: dict[str, Any] = _START.dump_python(self, exclude_defaults=True)
        return always | changed

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Start:
        """Return the start with the values that ``to_json`` returned, before or after a file stored them.

        Raises:
            ValueError: if a value is missing or has another type.
        """
        try:
            return _START.validate_python(dict(stored))
        except ValidationError as error:
            faults = [f"{fault['loc'][0]}: {fault['msg']}" for fault in error.errors()]
            raise ValueError(f"a start is not valid, {'; '.join(faults)}") from error


_START = TypeAdapter(Start)


@dataclass(frozen=True)
class Scene:
    """Scene that a replay starts in.

    Attributes:
        model_xml: MJCF with asset paths of this machine.
        state: (S,) flattened MuJoCo state: time, qpos, qvel.
        resolved: axis to the JSON-serialisable result of its perturbation in this scene, such as final object
            positions.
        start: gripper command, posture of the controller and push; by default as after LIBERO's reset.
    """

    model_xml: str
    state: Floats
    resolved: Mapping[str, Any] = field(default_factory=dict)
    start: Start = Start(gripper=0.0)


RollOut = Callable[[Scene, Demo], Floats]
"""Function that returns the (K+1, S) states through which a demonstration's actions lead from a scene."""


@dataclass(frozen=True)
class Verdict:
    """Decision to keep or drop a planned item.

    Attributes:
        kept: True if the item is kept.
        reason: ``kept``, or a short reason in snake_case, such as ``goal_not_reached``.
    """

    kept: bool
    reason: str


@dataclass(frozen=True)
class Quality:
    """Quality measures of a trajectory's motion (``physics/quality.py``): columns of the manifest, with their meanings.

    In these meanings, "another object" is not named by the goal. It also does not stand on or in anything that the goal
    moves.
    """

    non_target_moved_m: Annotated[
        float,
        "largest displacement of another object at any step, from the first observation; less than 1 mm counts as 0",
    ]
    non_target_left_m: Annotated[
        float, "largest displacement of another object after the last step; less than 1 mm counts as 0"
    ]
    touched_steps: Annotated[int, "number of steps after which the robot touches a thing that is not part of the goal"]
    path_m: Annotated[float, "length of the end effector's path"]
    jerk_rms_m_s3: Annotated[float, "root mean square of the end effector's jerk, by third differences at 20 Hz"]
    idle_share: Annotated[float, "share of steps in which hand and fingers move less than 0.5 mm and 0.25 degrees"]
    joint_margin_rad: Annotated[
        float, "smallest distance of a joint of the arm to its limit; below 0 if the joint exceeds the limit"
    ]
    lag_m: Annotated[float, "largest distance between the commanded and the reached position of the hand at any step"]


@dataclass(frozen=True)
class Trajectory:
    """Result of physics, without pixels.

    Attributes:
        trajectory_id: hash of everything that determines it.
        mode: method that produced its actions, ``open_loop`` or ``tracked``.
        scene: its start, before the arm and the objects settled; asset paths of this machine.
        states: (K+1, S) flattened states: before each executed action, and after the last. The first state is that of
            the first observation.
        actions: (K, 7) executed actions.
        site_alpha: (K+1, nsite) opacity of the model's sites; LIBERO uses a site to show a lit burner.
        verdict: the judge's decision after the last action.
        quality: quality measures; ``None`` if no action was executed or nothing was measured.
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
        """Return JSON of the results of physics perturbations by axis, or of the simulation error under ``fault``."""
        return json.dumps(self.scene.resolved, sort_keys=True)


@dataclass(frozen=True)
class Geometry:
    """Camera matrices of a view and its maps other than colours; ``schemas/episode.json`` defines the conventions.

    Attributes:
        intrinsics: (3, 3) float32, camera to pixels of the stored frame.
        extrinsics: (4, 4) float32, camera to the reference frame of the view: the world, or the end effector.
        maps: ``depth`` and ``segmentation``, where requested, to T PNG files, rotated like the frames.
        boxes: (T, 24, 4) float32, ``None`` if not requested.
    """

    intrinsics: NDArray[np.float32]
    extrinsics: NDArray[np.float32]
    maps: Mapping[Extra, Sequence[bytes]] = field(default_factory=dict)
    boxes: NDArray[np.float32] | None = None


class Subtask(NamedTuple):
    """Description of the current subtask in plain words, valid from the moment before the action ``step``."""

    step: int
    text: str


@dataclass(frozen=True)
class Rendered:
    """Everything that a policy may observe of one trajectory.

    Attributes:
        replay_mode: method that produced the trajectory's actions.
        state: (K, 8), joint_state, action, action_absolute: (K, 7); see ``schemas/episode.json``.
        streams: stream id to K encoded frames.
        rejected: stream id to the reason why it was not rendered.
        geometry: id of a stream's geometry to the geometry.
        object_poses: (K, 24, 7) float32, ``None`` if not requested.
        instances: names of the objects that segmentation, poses and boxes number; empty without these extras.
        quality: quality measures of the trajectory.
        subtasks: subtasks of the trajectory in their order.
    """

    replay_mode: str
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    action: NDArray[np.float32]
    action_absolute: NDArray[np.float32]
    streams: Mapping[str, Sequence[Jpeg]] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    geometry: Mapping[str, Geometry] = field(default_factory=dict)
    object_poses: NDArray[np.float32] | None = None
    instances: Sequence[str] = ()
    quality: Quality | None = None
    subtasks: Sequence[Subtask] = ()


class Replay(NamedTuple):
    """States and scene behind an episode, in double precision.

    Attributes:
        actions: (T, 7) executed actions.
        states: (T, S) flattened MuJoCo states before each action.
        scene: its start, before the arm and the objects settled; MJCF with portable names of files.
        origin_sha256: content hash of the human demonstration behind it.
    """

    actions: Floats
    states: Floats
    scene: Scene
    origin_sha256: str


@dataclass(frozen=True)
class Episode:
    """Observations of a policy, ready for the writers; names, units and signs are those of ``schemas/episode.json``.

    Attributes:
        episode_id: identity by content; it joins RLDS, LeRobot and manifest.
        frames: view name (``image``, ``wrist_image``) to T JPEG files, already rotated.
        state: (T, 8), joint_state, action, action_absolute: (T, 7); all float32.
        instruction: the text the policy is prompted with.
        provenance: the columns named in ``schemas/episode.json``.
        geometry: view name to its camera matrices and maps.
        object_poses, instances: as in ``Rendered``.
        rewrites: other wordings of its task, for training.
        subtasks: its subtasks in their order; empty if the trajectory manipulates nothing that the goal names.
        replay: its states and its scene; ``None`` if not requested.
    """

    episode_id: str
    frames: Mapping[str, Sequence[Jpeg]]
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    action: NDArray[np.float32]
    action_absolute: NDArray[np.float32]
    instruction: str
    provenance: Mapping[str, str | int | float]
    geometry: Mapping[str, Geometry]
    object_poses: NDArray[np.float32] | None = None
    instances: Sequence[str] = ()
    rewrites: Sequence[str] = ()
    subtasks: Sequence[Subtask] = ()
    replay: Replay | None = None

    def __len__(self) -> int:
        return len(self.action)
