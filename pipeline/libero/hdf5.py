"""LIBERO's HDF5 layout: functions that read it and check every part, and functions that write it."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.libero.assets import package_folder
from pipeline.libero.carried import bddl_text, definition_of, file_name
from pipeline.types import Floats, Task

SUFFIX = "_demo.hdf5"
"""Text after the name of a task in the name of the file of its demonstrations."""

GET_AGAIN = (
    "compare the file with its source, and copy or download it again into another folder; the starter set needs no file"
)
"""Remedy for a file that was damaged after it was written.

The file may be its owner's only copy, so no remedy advises to delete it.
"""

AS_RECORDED = (
    "write it as LIBERO's create_dataset.py does, into a new file; or leave it as it is: a run skips it, if its task "
    "has another demonstration"
)
"""Remedy for an undamaged file whose content has another form."""

_REPACK = (
    "write a copy without compression, `h5repack -f NONE FILE COPY` (package hdf5-tools), on a machine with the "
    "filter's plugin: HDF5 itself lacks filters such as blosc"
)
REMEDIES = {
    "consistency flags": "copy the file, and clear the mark in the copy by `h5clear -s COPY` (package hdf5-tools): its "
    "recorder was killed while the file was open",
    "plugin": _REPACK,
    "filter": _REPACK,
}
"""Part of a message of HDF5 to the remedy."""

EXPANDED_FROM, EXPANDED_FROM_SHA256, ORIGIN_SHA256 = "expanded_from", "expanded_from_sha256", "origin_sha256"
"""Attributes of a demonstration that an expansion generated.

They hold the id and the content hash of its direct source, and the content hash of the human demonstration at its
origin.
"""

EXPANDED_BY = "expanded_by"
"""Attribute of a demonstration with the name and version of the program whose expansion wrote it."""

FRAME_PX = 128
"""Height and width of the frames in LIBERO's files."""

IMAGES_NDIM = 4
"""Number of dimensions of an array of images (T, H, W, C)."""

COMPRESSION: Mapping[str, Any] = {"compression": "gzip", "compression_opts": 1}
"""Lossless compression of images, which HDF5 itself reads; ``docs/formats.md`` has other levels."""

# LIBERO's longest demonstrations have about 500 steps. Without a limit, a few bytes of header could request all memory.
_MAX_NUMBERS = 10_000_000
_Node = TypeVar("_Node", h5py.Group, h5py.Dataset)


class Expanded(NamedTuple):
    """The start of an expanded demonstration: JSON of its perturbations, and the seed of the reset, if it is one."""

    perturbations: str
    reset_seed: str | None


@contextmanager
def _undamaged(where: str) -> Iterator[None]:
    """Replace every error that h5py raises on truncated or overwritten bytes by one error."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, TypeError, ValueError) as error:
        remedies = [remedy for words, remedy in REMEDIES.items() if words in str(error)]
        remedy = remedies[0] if remedies else GET_AGAIN
        raise PipelineError(
            f"the file is not readable as HDF5 ({error})", where=where, expected="a whole HDF5 file", remedy=remedy
        ) from error


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading.

    Raises:
        PipelineError: when the file is missing or truncated.
    """
    if not path.is_file():
        raise PipelineError(
            "there is no such file", where=path, remedy="download it, or leave its task out of demos.tasks"
        )
    with _undamaged(str(path)):
        # Many workers read and no process writes, and locks fail on some network file systems.
        file = h5py.File(path, "r", locking=False)
    with file:
        yield file


def names(group: h5py.Group, where: str) -> list[str]:
    """List a group's member names in natural order, ``demo_2`` before ``demo_10``."""

    def natural(name: str) -> list[str]:
        """Return a sort key whose numbers have leading zeros."""
        return [part.zfill(20) for part in re.split(r"(\d+)", name)]

    with _undamaged(where):
        # h5py returns a name that is not UTF-8 as bytes.
        decoded = [name if isinstance(name, str) else name.decode(errors="backslashreplace") for name in group]
        return sorted(decoded, key=natural)


def member(group: h5py.Group, name: str, kind: type[_Node], where: str) -> _Node:
    """Return a group's member, which must be of the given kind and in the same file: a link could lead to any file."""
    with _undamaged(where):
        link = group.get(name, getlink=True)
        node = group[name] if isinstance(link, h5py.HardLink) else link
    if not isinstance(node, kind):
        what = "missing" if node is None else f"a {type(node).__name__}"
        raise PipelineError(f"{name!r} is {what}", where=where, expected=f"a {kind.__name__}", remedy=AS_RECORDED)
    return node


def array(group: h5py.Group, name: str, where: str) -> Floats:
    """Read a group's (T, N) dataset of floating-point numbers."""
    dataset = member(group, name, h5py.Dataset, where)
    with _undamaged(where):
        if dataset.external or dataset.is_virtual:
            raise PipelineError(f"{name!r} stores its numbers in another file", where=where, remedy=AS_RECORDED)
        if dataset.dtype.kind != "f" or dataset.ndim != 2 or not 0 < dataset.size <= _MAX_NUMBERS:
            raise PipelineError(
                f"{name!r} holds {dataset.dtype} of shape {dataset.shape}",
                where=where,
                expected="floating-point numbers of shape (T, N)",
                remedy=AS_RECORDED,
            )
        return np.asarray(dataset[()], np.float64)


def numbers(group: h5py.Group, name: str, where: str) -> Floats | None:
    """Read a group's attribute as floating-point numbers; return `None` if the group lacks the attribute."""
    with _undamaged(where):
        return np.asarray(group.attrs[name], np.float64) if name in group.attrs else None


def masks(file: h5py.File) -> list[str]:
    """Return the names of robomimic's lists of demonstrations, such as ``train``; the lists are not read."""
    return names(file["mask"], str(file.filename)) if isinstance(file.get("mask"), h5py.Group) else []


def text(group: h5py.Group, name: str, where: str) -> str:
    """Read a group's text attribute."""
    with _undamaged(where):
        value = group.attrs.get(name)
        if isinstance(value, bytes):
            value = value.decode()
    if not isinstance(value, str):
        raise PipelineError(
            f"attribute {name!r} is {'missing' if value is None else 'not text'}",
            where=where,
            expected="LIBERO's own files, which record the scene of every demonstration in model_file",
            remedy="use the published files, not a re-rendered or converted copy of them",
        )
    # h5py reads bytes that are not UTF-8 as lone surrogates, which cannot be encoded again.
    if not value.isascii() and any("\ud800" <= character <= "\udfff" for character in value):
        raise PipelineError(f"attribute {name!r} is not UTF-8", where=where, remedy=AS_RECORDED)
    return value


@dataclass(frozen=True)
class Recording:
    """A demonstration with all its states, in the form of LIBERO's HDF5 files.

    Attributes:
        actions: (T, 7) OSC_POSE deltas and gripper, in [-1, 1].
        states: (T, S) flattened MuJoCo state before each action: time, qpos, qvel.
        robot_states: (T, 9) finger positions, end-effector position in m, end-effector quaternion (x, y, z, w).
        model_file: MJCF of the scene.
        obs: name to (T, ...), such as ``agentview_rgb`` (T, 128, 128, 3) or ``ee_pos`` (T, 3).
        attrs: further attributes.
        further: name to further arrays (T, ...) of the steps.
        success: True if the last step reaches the goal and is rewarded.
    """

    actions: Floats
    states: Floats
    robot_states: Floats
    model_file: str
    obs: Mapping[str, NDArray[Any]]
    attrs: Mapping[str, Any] = field(default_factory=dict)
    further: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    success: bool = True


def proprioception(hands: Floats, joints: Floats) -> dict[str, Floats]:
    """Return LIBERO's observations without images, by name.

    Args:
        hands: (T, 8) end-effector position in m, axis-angle in rad, two finger positions in m.
        joints: (T, 7) joint angles of the arm in rad.
    """
    return {
        "ee_pos": hands[:, :3],
        "ee_ori": hands[:, 3:6],
        "ee_states": hands[:, :6],
        "gripper_states": hands[:, 6:],
        "joint_states": joints,
    }


def demo_file(root: Path, task: Task) -> Path:
    """Return the file of a task's demonstrations in a folder with LIBERO's layout."""
    return root / task.suite / f"{task.name}{SUFFIX}"


def task_attributes(task: Task, frame_px: int = FRAME_PX) -> dict[str, str]:
    """Return the attributes of the group ``data`` that depend only on the task and the size of the frames."""
    definition = definition_of(task)
    bddl_file = f"libero/libero/bddl_files/{task.suite}/{file_name(task)}.bddl"
    controller = package_folder("robosuite") / "controllers" / "config" / "osc_pose.json"
    env_kwargs = {
        "robots": ["Panda"],
        "controller_configs": json.loads(controller.read_text()),
        "bddl_file_name": bddl_file,
        "has_renderer": False,
        "has_offscreen_renderer": True,
        "ignore_done": True,
        "use_camera_obs": True,
        "camera_depths": False,
        "camera_names": ["robot0_eye_in_hand", "agentview"],
        "reward_shaping": True,
        "control_freq": 20,
        "camera_heights": frame_px,
        "camera_widths": frame_px,
        "camera_segmentations": None,
    }
    env_args = {
        "type": 1,
        # LIBERO's name of the class, such as Libero_Tabletop_Manipulation.
        "env_name": definition.problem.title(),
        "problem_name": definition.problem,
        "bddl_file": bddl_file,
        "env_kwargs": env_kwargs,
    }
    problem_info = {
        "problem_name": definition.problem,
        "domain_name": "robosuite",
        "language_instruction": definition.language,
    }
    return {
        "env_name": str(env_args["env_name"]),
        "env_args": json.dumps(env_args),
        "problem_info": json.dumps(problem_info),
        "bddl_file_name": bddl_file,
        "bddl_file_content": bddl_text(task),
        "macros_image_convention": "opengl",
        "tag": "libero-v1",
    }


def write(path: Path, task: Task, recordings: Iterable[Recording], frame_px: int = FRAME_PX) -> None:
    """Write a task's demonstrations in the form that LIBERO publishes, for programs that read LIBERO's files.

    Equal recordings give equal bytes. Memory holds one recording at a time.

    Args:
        frame_px: height and width of the frames, which the file states.
    """
    with replaced(path) as temporary, h5py.File(temporary, "w") as file:
        data, total, count = file.create_group("data"), 0, 0
        for count, recording in enumerate(recordings, start=1):
            _write_demo(data.create_group(f"demo_{count - 1}"), recording)
            total += len(recording.actions)
        data.attrs.update(task_attributes(task, frame_px), num_demos=count, total=total)


def _write_demo(group: h5py.Group, recording: Recording) -> None:
    """Write one demonstration into its group; the end, and the reward of a success, are 1 at the last step.

    Images are compressed, each by itself, so that a reader of one step decompresses one image.
    """
    steps = len(recording.actions)
    at_end = np.zeros(steps, np.uint8)
    at_end[-1] = 1
    content: dict[str, NDArray[Any]] = {
        "actions": recording.actions,
        "states": recording.states,
        "robot_states": recording.robot_states,
        "rewards": at_end if recording.success else np.zeros_like(at_end),
        "dones": at_end,
        **recording.further,
        **{f"obs/{name}": values for name, values in recording.obs.items()},
    }
    for name, values in content.items():
        if values.ndim == IMAGES_NDIM:
            group.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **COMPRESSION)
        else:
            group.create_dataset(name, data=values)
    group.attrs.update(num_samples=steps, model_file=recording.model_file, init_state=recording.states[0])
    group.attrs.update(recording.attrs)


def origin_sha256(group: h5py.Group) -> str | None:
    """Read the content hash of the human demonstration that an expansion started from.

    Return `None` for a human demonstration. Expansions by earlier versions name only their direct source, which may be
    an expansion too.
    """
    for name in (ORIGIN_SHA256, EXPANDED_FROM_SHA256):
        if name in group.attrs:
            return str(group.attrs[name])
    return None


def expansions(file: Path) -> list[Expanded | None]:
    """Return the expansion of each demonstration of a file; `None` for a demonstration that no expansion wrote.

    An exported episode of an expanded demonstration has the attribute ``EXPANDED_FROM`` too, but not ``EXPANDED_BY``.

    Raises:
        PipelineError: when the file does not have LIBERO's layout.
    """
    found: list[Expanded | None] = []
    with opened(file) as content:
        data = member(content, "data", h5py.Group, str(file))
        for key in names(data, str(file)):
            attrs = member(data, key, h5py.Group, f"{file} data/{key}").attrs
            written = EXPANDED_BY in attrs
            found.append(Expanded(str(attrs.get("perturbations")), attrs.get("reset_seed")) if written else None)
    return found
