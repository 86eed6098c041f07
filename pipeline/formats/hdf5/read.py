"""Reader and checks of episodes in LIBERO's HDF5 layout."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA, Content
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import Edition, edition
from pipeline.formats.base import ManifestRow
from pipeline.formats.hdf5 import layout
from pipeline.formats.hdf5.write import REPEATED
from pipeline.formats.read_back import (
    Copy,
    Fault,
    in_both_splits,
    sampled,
    subtasks_of,
    too_many_episodes,
    unlike,
    wrong_splits,
)
from pipeline.images.jpeg import encode_exactly, to_policy
from pipeline.libero import hdf5
from pipeline.types import Episode, Extra, Frame, Geometry, Replay, Scene

FORMAT = "hdf5"

MARKS = {"reward": "rewards", "is_last": "dones"}
"""Name of a column of the checks to the array that has it."""


class Place(NamedTuple):
    """Place of an episode: its file, and the name of its group."""

    file: Path
    demo: str


@contextmanager
def _readable(where: object) -> Iterator[None]:
    """Replace the errors that h5py raises on damaged or missing content by one error."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise PipelineError(
            f"cannot be read ({type(error).__name__}: {error})", where=where, expected="a whole file", remedy=MAKE_AGAIN
        ) from error


def files_of(root: Path) -> list[Path]:
    """List the files of a dataset.

    Raises:
        PipelineError: when it has none.
    """
    files = sorted([*root.glob(f"*/*{hdf5.SUFFIX}"), *root.glob(f"{layout.VALIDATION_FOLDER}/*/*{hdf5.SUFFIX}")])
    if not files:
        raise PipelineError("no HDF5 file", where=root, expected="<suite>/<task>_demo.hdf5", remedy=MAKE_AGAIN)
    return files


def open_all(root: Path) -> None:
    """Open every file.

    Raises:
        PipelineError: when a file cannot be opened, or none exists.
    """
    for file in files_of(root):
        _demos(edition(file))


def _split_of(root: Path, file: Path) -> str:
    return "val" if file.relative_to(root).parts[0] == layout.VALIDATION_FOLDER else "train"


@lru_cache(maxsize=100)
def _demos(file: Edition) -> dict[str, str]:
    """Map the name of each group of a file, in LIBERO's order, to the id of its episode."""
    with _readable(file.path), hdf5.opened(file.path) as content:
        groups = content["data"]
        return {name: str(groups[name].attrs["episode_id"]) for name in hdf5.names(groups, str(file.path))}


def check(
    root: Path, kept: Mapping[str, ManifestRow], content: Content, validation: float = 0.0
) -> Iterator[tuple[str, Fault]]:
    """Compare the files with the layout, and their episodes with the kept episodes."""
    split_of: dict[str, str] = {}
    stored = 0
    for file in files_of(root):
        demos = _demos(edition(file))
        stored += len(demos)
        split_of |= dict.fromkeys(demos.values(), _split_of(root, file))
        with _readable(file), hdf5.opened(file) as opened:
            yield from (("format", fault) for fault in _wrong_file(file, opened, demos, content))
    yield from too_many_episodes(FORMAT, stored, len(kept))
    yield from wrong_splits(FORMAT, {*split_of.values()}, validation)
    yield from in_both_splits(FORMAT, split_of, kept)


def _wrong_file(file: Path, opened: h5py.File, demos: Mapping[str, str], content: Content) -> Iterator[Fault]:
    """Compare the attributes of a file, and the arrays of its episodes, with the layout."""
    data, name = opened["data"], f"{file.parent.name}/{file.name}"
    samples = {demo: int(data[demo].attrs["num_samples"]) for demo in demos}
    wanted: dict[str, Any] = {
        "demonstrations": [f"demo_{number}" for number in range(len(demos))],
        **hdf5.task_attributes(layout.task_of(file), content.size_px),
        "num_demos": len(demos),
        "total": sum(samples.values()),
    }
    yield from unlike(FORMAT, {"demonstrations": list(demos), **data.attrs}, wanted, f"{name}: ")
    for demo, steps in samples.items():
        group = data[demo]
        found: dict[str, str] = {}

        def note(member: str, node: h5py.Group | h5py.Dataset, found: dict[str, str] = found) -> None:
            if isinstance(node, h5py.Dataset):
                found[member] = f"{node.dtype}{node.shape}"

        group.visititems(note)
        arrays = _arrays(steps, len(group.attrs["init_state"]), content)
        yield from unlike(FORMAT, {"arrays": found}, {"arrays": arrays}, f"{name} {demo}: ")
        if not np.array_equal(group.attrs["init_state"], group["states"][0]):
            yield Fault(FORMAT, demos[demo], "init_state differs from the first state", "the first state")
        if found == arrays:
            yield from _wrong_copies(group, demos[demo])


SAME_STATE = 1e-9
"""Largest difference of entries of ``robot_states`` between processors, in m and parts of a quaternion."""


def _wrong_copies(group: h5py.Group, episode_id: str) -> Iterator[Fault]:
    """Compare LIBERO's arrays that repeat the pose of the hand and the fingers with the arrays that ``read`` reads."""
    obs = group["obs"]
    position, orientation, fingers = (obs[name][()] for name in ("ee_pos", "ee_ori", "gripper_states"))
    if not np.array_equal(obs["ee_states"], np.hstack([position, orientation])):
        yield Fault(FORMAT, episode_id, "obs/ee_states differs from obs/ee_pos and obs/ee_ori", "the same numbers")
    expected = np.hstack([fingers, position, layout.quaternions(orientation)])
    if not np.allclose(group["robot_states"], expected, rtol=0, atol=SAME_STATE):
        what = "robot_states differs from obs/gripper_states, obs/ee_pos and obs/ee_ori"
        yield Fault(FORMAT, episode_id, what, "the same numbers, the orientation as a quaternion")


def _arrays(steps: int, numbers: int, content: Content) -> dict[str, str]:
    """Return the arrays of an episode by name, each with its type and shape in words.

    Args:
        steps: number of actions.
        numbers: size of a flattened state.
    """
    widths = {"actions": 7, "states": numbers, "robot_states": 9}
    widths |= {"obs/ee_pos": 3, "obs/ee_ori": 3, "obs/ee_states": 6, "obs/gripper_states": 2, "obs/joint_states": 7}
    arrays = {name: f"float64{(steps, width)}" for name, width in widths.items()}
    arrays |= dict.fromkeys(("rewards", "dones"), f"uint8{(steps,)}")
    arrays["action_absolute"] = f"float32{(steps, 7)}"
    map_shape = (steps, content.size_px, content.size_px, 1)
    for view in content.views:
        arrays[layout.frames_key(view)] = f"uint8{(steps, *content.frame_shape)}"
        for name in content.maps:
            arrays[layout.maps_key(view, name)] = f"{getattr(SCHEMA, name).dtype}{map_shape}"
        if "boxes" in content.extras:
            arrays[layout.maps_key(view, "boxes")] = f"{SCHEMA.boxes.dtype}{(steps, *SCHEMA.boxes.shape)}"
    if "object_poses" in content.extras:
        arrays[layout.OBJECT_POSES] = f"float32{(steps, *SCHEMA.object_poses.shape)}"
    return arrays


def read(root: Path, episode_id: str, content: Content) -> Copy | None:
    """Read an episode; ``None`` when the dataset does not have it.

    Raises:
        PipelineError: when it cannot be read.
    """
    place = _places(tuple(map(edition, files_of(root)))).get(episode_id)
    if place is None:
        return None
    with _readable(f"{place.file} data/{place.demo}"), hdf5.opened(place.file) as opened:
        return _copy(place, opened[f"data/{place.demo}"], content, _split_of(root, place.file) == "train")


def _frames(place: Place, view: str) -> Iterator[Frame]:
    """Yield the frames of a view of an episode, rotated as in an ``Episode``, with one frame at a time in memory."""
    name = f"data/{place.demo}/{layout.frames_key(view)}"
    with _readable(f"{place.file} {name}"), hdf5.opened(place.file) as opened:
        for frame in opened[name]:
            yield to_policy(frame)


@lru_cache(maxsize=1)
def _places(files: tuple[Edition, ...]) -> dict[str, Place]:
    places: dict[str, Place] = {}
    for file in files:
        for demo, episode_id in _demos(file).items():
            places[episode_id] = Place(file.path, demo)
    return places


def _copy(place: Place, group: h5py.Group, content: Content, train: bool) -> Copy:
    attributes = dict(group.attrs)
    obs, actions = group["obs"], group["actions"][()]
    state = np.hstack([obs["ee_pos"][()], obs["ee_ori"][()], obs["gripper_states"][()]])
    instruction = str(attributes["instruction"])
    # An episode without a label lacks its attribute.
    labels = {name: attributes.get(name, ()) for name in SCHEMA.labels}
    poses = group[layout.OBJECT_POSES][()] if "object_poses" in content.extras else None
    episode = Episode(
        episode_id=str(attributes["episode_id"]),
        frames={},
        state=state.astype(np.float32),
        joint_state=obs["joint_states"][()].astype(np.float32),
        action=actions.astype(np.float32),
        action_absolute=group["action_absolute"][()],
        instruction=instruction,
        provenance={name: _as_python_value(attributes[name]) for name in content.provenance},
        geometry={view: _geometry(group, attributes, view, content) for view in content.views},
        object_poses=poses,
        instances=json.loads(attributes[layout.INSTANCES]) if content.has_names else (),
        rewrites=tuple(map(str, labels["rewrites"])),
        subtasks=subtasks_of(labels["subtask_starts"], labels["subtask_texts"]),
        replay=Replay(actions, group["states"][()], scene_of(attributes), str(attributes[hdf5.ORIGIN_SHA256])),
    )
    decoded: dict[tuple[str, int], Frame] = {}
    for view in content.views:
        for step in sampled(len(actions)):
            decoded[view, step] = to_policy(group[layout.frames_key(view)][step])
    return Copy(
        dataset=FORMAT,
        episode=episode,
        instructions=[instruction] * len(actions),
        decoded=decoded,
        step_marks={name: group[array][()] for name, array in MARKS.items()},
        place={},
        train=train,
        lossless_frames=partial(_frames, place),
        repeated={name: (column, str(attributes[name])) for name, column in REPEATED.items()},
    )


def scene_of(attributes: Mapping[str, Any]) -> Scene:
    """Return the scene in which an episode's replay starts; its model has portable names of files."""
    model_xml, state = str(attributes["model_file"]), attributes[layout.START_STATE]
    return Scene(model_xml, state, start=layout.start_of(attributes))


def _as_python_value(value: Any) -> Any:
    """Return an attribute as Python's own type."""
    return value.item() if isinstance(value, np.generic) else value


def _geometry(group: h5py.Group, attributes: Mapping[str, Any], view: str, content: Content) -> Geometry:
    maps: dict[Extra, list[bytes]] = {}
    for name in content.maps:
        stored: NDArray[Any] = group[layout.maps_key(view, name)][()]
        maps[name] = [encode_exactly(to_policy(each[..., 0])) for each in stored]
    boxes = None
    if "boxes" in content.extras:
        boxes = layout.boxes_turned_back(group[layout.maps_key(view, "boxes")][()], content.size_px)
    intrinsics = layout.turned_back(attributes[layout.matrix_attribute(view, "intrinsics")], content.size_px)
    extrinsics = attributes[layout.matrix_attribute(view, "extrinsics")]
    return Geometry(intrinsics.astype(np.float32), extrinsics, maps, boxes)
