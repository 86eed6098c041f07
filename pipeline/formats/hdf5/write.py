"""Writer of episodes in LIBERO's HDF5 layout."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_check import check
from pipeline.episode_schema import SCHEMA, Content, labels_of
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.hdf5 import layout
from pipeline.images.jpeg import decode, decode_exactly, to_policy
from pipeline.libero import hdf5
from pipeline.types import Episode, Replay

REPEATED = {hdf5.EXPANDED_FROM: "demo_id", hdf5.EXPANDED_FROM_SHA256: "demo_sha256"}
"""Attributes with the names of ``demos expand``, to the column of the provenance that they repeat.

They mark an episode as generated, so that a run that reads the file as demonstrations knows the human demonstration
behind it.
"""


def write_file(path: Path, piece: Piece, load: Load, content: Content) -> None:
    """Write the episodes of one task.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    hdf5.write(path, layout.task_of(Path(piece.path)), _recordings(piece, load, content), content.size_px)


def _recordings(piece: Piece, load: Load, content: Content) -> Iterator[hdf5.Recording]:
    for episode_id in piece.ids:
        episode = load(episode_id)
        check(episode, content)
        yield _recording(episode, content)


def _recording(episode: Episode, content: Content) -> hdf5.Recording:
    """Convert an episode to a recording in which everything precedes the action of its step."""
    replay = episode.replay
    if replay is None:
        raise PipelineError("the episode has no replay", where=f"episode {episode.episode_id}", expected="its states")
    hands, joints = episode.state.astype(np.float64), episode.joint_state.astype(np.float64)
    return hdf5.Recording(
        actions=replay.actions,
        states=replay.states,
        robot_states=np.hstack([hands[:, 6:], hands[:, :3], layout.quaternions(hands[:, 3:6])]),
        model_file=replay.scene.model_xml,
        obs=hdf5.proprioception(hands, joints) | _images(episode, content),
        attrs=_start(replay) | _attributes(episode, content),
        further={"action_absolute": episode.action_absolute},
        success=bool(episode.provenance.get("success", True)),
    )


def _start(replay: Replay) -> dict[str, Any]:
    """Return the attributes with which a replay can be repeated."""
    return {
        hdf5.ORIGIN_SHA256: replay.origin_sha256,
        layout.START_STATE: replay.scene.state,
        **layout.start_attributes(replay.scene.start),
    }


def _images(episode: Episode, content: Content) -> dict[str, NDArray[Any]]:
    """Return frames and extras in the orientation of LIBERO's raw frames, by their names below ``obs``."""
    arrays: dict[str, NDArray[Any]] = {}
    for view, files in episode.frames.items():
        # A rotation by 180 degrees is its own inverse.
        arrays[layout.frames_key(view)] = np.stack([to_policy(decode(file)) for file in files])
    for view, geometry in episode.geometry.items():
        for name in content.maps:
            maps = [to_policy(decode_exactly(file)) for file in geometry.maps[name]]
            arrays[layout.maps_key(view, name)] = np.stack(maps)[..., None]
        if geometry.boxes is not None:
            arrays[layout.maps_key(view, "boxes")] = layout.boxes_turned_back(geometry.boxes, content.size_px)
    if episode.object_poses is not None:
        arrays[layout.OBJECT_POSES] = episode.object_poses
    return {name.removeprefix("obs/"): values for name, values in arrays.items()}


def _attributes(episode: Episode, content: Content) -> dict[str, Any]:
    """Return the labels of an episode."""
    stated = episode.provenance
    attributes: dict[str, Any] = {name: stated[column] for name, column in REPEATED.items()}
    attributes["instruction"] = episode.instruction
    for name, kind in content.provenance.items():
        attributes[name] = np.float32(stated[name]) if kind == "float32" else stated[name]
    for view, geometry in episode.geometry.items():
        attributes[layout.matrix_attribute(view, "intrinsics")] = layout.turned_back(
            geometry.intrinsics, content.size_px
        )
        attributes[layout.matrix_attribute(view, "extrinsics")] = geometry.extrinsics
    if content.has_names:
        attributes[layout.INSTANCES] = json.dumps(list(episode.instances))
    for name, values in labels_of(episode).items():
        if values:
            dtype = h5py.string_dtype() if SCHEMA.labels[name] == "string" else SCHEMA.labels[name]
            attributes[name] = np.array(values, dtype)
    return attributes
