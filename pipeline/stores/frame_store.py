"""Rendered trajectories on disk; episodes that show the same frames share one stream of them.

A trajectory has a folder, and in it a file for each set of streams that were rendered together.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.config import RenderConfig
from pipeline.episode_schema import MAPS, MATRICES, SCHEMA, SIZE_PX
from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.identity import MAPS_RECIPE, OTHER_SIZE_RECIPE
from pipeline.seeding import digest
from pipeline.stores.sealed_file import SealedFile
from pipeline.stores.store import SUFFIX, Store
from pipeline.types import Geometry, Jpeg, Quality, Rendered, Subtask

_OF_THE_SCHEMA = {"views", "frame", *MATRICES, *MAPS, "object_poses", "boxes"}
"""Parts of the schema that describe the content of a store's files."""


@dataclass(frozen=True)
class StoredFrames:
    """Record of one trajectory's stored frames, in all its files.

    Attributes:
        fingerprint: value of the table's column ``made_by``.
        device, replay_mode, actions_sha256: values of the table's columns.
        streams: ids of the rendered streams.
        rejected: id of each rejected stream to the reason.
        subtasks: subtasks of the trajectory; empty without rendered streams.
    """

    fingerprint: str
    device: str
    replay_mode: str
    actions_sha256: str
    streams: set[str] = field(default_factory=set)
    rejected: dict[str, str] = field(default_factory=dict)
    subtasks: Sequence[Subtask] = ()


class FrameStore(Store):
    """Frames under one folder.

    The columns of its table are ``device`` (OpenGL name of the device that rendered), ``replay_mode``, ``steps``,
    ``actions_sha256`` (of the stored actions) and ``streams`` (ids of the rendered streams). Two columns are JSON:
    ``rejected``, the id of each rejected stream to the reason, and ``subtasks``, pairs of step and text. A file's name
    is ``<trajectory id>/<digest of its streams>``.

    Frames that were encoded with another ``render_config`` count as missing. Further views are streams of their own.
    """

    step, pattern = "encoding", f"*/*{SUFFIX}"
    columns: ClassVar = {
        "device": pa.string(),
        "replay_mode": pa.string(),
        "steps": pa.int64(),
        "actions_sha256": pa.string(),
        "streams": pa.list_(pa.string()),
        "rejected": pa.string(),
        "subtasks": pa.string(),
    }

    def __init__(self, root: Path, render_config: RenderConfig):
        schema = [SCHEMA.model_dump(include=_OF_THE_SCHEMA), SCHEMA.image_rotation_deg]
        maps = {"recipe of maps": MAPS_RECIPE} if {*MAPS, "boxes"} & {*render_config.extras} else {}
        size = {"recipe of the size": OTHER_SIZE_RECIPE} if render_config.size_px != SIZE_PX else {}
        super().__init__(root, settings_of(render_config), {"episode schema": schema, **maps, **size})

    @staticmethod
    def describe(file: SealedFile) -> dict[str, Any]:
        attributes = {name: file.attributes[name] for name in ("device", "replay_mode", "rejected", "subtasks")}
        action = file.array("action")
        actions_sha256 = hashlib.sha256(action.tobytes()).hexdigest()
        streams = _members(file, "streams")
        return {**attributes, "steps": len(action), "actions_sha256": actions_sha256, "streams": streams}

    def folder(self, trajectory_id: str) -> Path:
        return self.root / trajectory_id

    def save(self, trajectory_id: str, rendered: Rendered, device: str) -> None:
        """Store rendered streams of a trajectory in their own file.

        Args:
            device: OpenGL name of the device that rendered them.
        """
        attributes = {
            "device": device,
            "replay_mode": rendered.replay_mode,
            "instances": list(rendered.instances),
            "rejected": json.dumps(dict(rendered.rejected), sort_keys=True),
            "quality": asdict(rendered.quality) if rendered.quality else None,
            "subtasks": json.dumps(list(rendered.subtasks)),
        }
        arrays: dict[str, NDArray[Any]] = {
            "state": rendered.state,
            "joint_state": rendered.joint_state,
            "action": rendered.action,
            "action_absolute": rendered.action_absolute,
        }
        for stream_id, frames in sorted(rendered.streams.items()):
            arrays |= _packed(f"streams/{stream_id}", frames)
        for geometry_id, geometry in sorted(rendered.geometry.items()):
            view = f"geometry/{geometry_id}"
            arrays |= {f"{view}/{name}": getattr(geometry, name) for name in MATRICES}
            for extra, files in geometry.maps.items():
                arrays |= _packed(f"{view}/{extra}", files)
            if geometry.boxes is not None:
                arrays[f"{view}/boxes"] = geometry.boxes
        if rendered.object_poses is not None:
            arrays["object_poses"] = rendered.object_poses
        self.write(file_name(trajectory_id, {*rendered.streams, *rendered.rejected}), arrays, attributes)

    def load(self, trajectory_id: str, streams: Collection[str], geometry: Collection[str] = ()) -> Rendered:
        """Read the named streams of a trajectory.

        Args:
            streams: ids of at least one stream.
            geometry: ids of the geometry to read with them.

        Raises:
            PipelineError: when a file is damaged, or a stream or its geometry is missing.
        """
        frames, views = set(streams), set(geometry)
        parts: list[Rendered] = []
        for name in self._files_of(trajectory_id):
            if not frames and not views:
                break
            with self.opened(name) as file:
                frames_of_file = frames & {*_members(file, "streams")}
                views_of_file = views & {*_members(file, "geometry")}
                if frames_of_file or views_of_file:
                    parts.append(_rendered(file, frames_of_file, views_of_file))
            frames, views = frames - frames_of_file, views - views_of_file
        if frames or views or not parts:
            raise PipelineError(
                f"the streams {sorted(frames | views)} are not rendered",
                where=self.folder(trajectory_id),
                remedy=f"{RUN_AGAIN}, which renders them",
            )
        return merged(parts)

    def stored(self, trajectory_id: str, streams: Mapping[str, str], device: str) -> list[Rendered]:
        """Read the named streams of a trajectory, as far as up-to-date files have them, each stream once.

        Args:
            streams: id of a stream to the id of its geometry.
            device: OpenGL device that must have rendered them.

        Raises:
            PipelineError: when a file is damaged.
        """
        parts: list[Rendered] = []
        missing = set(streams)
        for name in self._files_of(trajectory_id):
            row = self.row(name)
            if row is None or row["device"] != device:
                continue
            rendered = missing & set(row["streams"])
            rejected = {stream: why for stream, why in json.loads(row["rejected"]).items() if stream in missing}
            if rendered or rejected:
                with self.opened(name) as file:
                    part = _rendered(file, rendered, {streams[stream] for stream in rendered})
                parts.append(replace(part, rejected=rejected))
            missing -= {*rendered, *rejected}
        return parts

    def outdated_of(self, trajectories: Collection[str], device: str | None) -> Counter[str]:
        """Count by reason the outdated files of some trajectories; with a device, also the files of other devices."""
        names = [name for name in self.names_of_all_versions() if name.split("/")[0] in trajectories]
        reasons = self.outdated(names)
        rows = self.rows()
        for name in names if device else ():
            if name in rows and rows[name]["device"] != device:
                reasons[f"OpenGL device {rows[name]['device']}, here {device}"] += 1
        return reasons

    def motion(self, trajectory_id: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Read action (K, 7) and state (K, 8) of a trajectory, without its frames.

        Raises:
            PipelineError: when a file is damaged, or no file has frames.
        """
        for name in self._files_of(trajectory_id):
            with self.opened(name) as file:
                if _members(file, "streams"):
                    return file.array("action"), file.array("state")
        raise PipelineError(
            "the trajectory has no rendered frames",
            where=self.folder(trajectory_id),
            remedy=f"{RUN_AGAIN}, which renders them",
        )

    def _files_of(self, trajectory_id: str) -> list[str]:
        return sorted(f"{trajectory_id}/{path.stem}" for path in self.folder(trajectory_id).glob(f"*{SUFFIX}"))


def settings_of(render_config: RenderConfig) -> dict[str, Any]:
    """Return the settings on which a stored stream depends; a further view is a stream of its own."""
    return render_config.model_dump(mode="json", exclude={"views"})


def file_name(trajectory_id: str, streams: Iterable[str]) -> str:
    """Return the name of the file with these streams of a trajectory, or with the reasons of their rejection."""
    return f"{trajectory_id}/{digest(*sorted(streams))[:16]}"


def frames_by_trajectory(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, StoredFrames]:
    """Map trajectory ids to the records of their stored frames, from the rows of the table."""
    stored: dict[str, StoredFrames] = {}
    for name, row in rows.items():
        trajectory_id = name.split("/")[0]
        if trajectory_id not in stored:
            stored[trajectory_id] = StoredFrames(
                row["made_by"], row["device"], row["replay_mode"], row["actions_sha256"]
            )
        stored[trajectory_id].streams.update(row["streams"])
        stored[trajectory_id].rejected.update(json.loads(row["rejected"]))
        if row["streams"]:  # A file of lost workers alone has no subtasks.
            stored[trajectory_id] = replace(stored[trajectory_id], subtasks=_subtasks(row["subtasks"]))
    return stored


def _subtasks(subtasks_json: str) -> tuple[Subtask, ...]:
    return tuple(Subtask(step, text) for step, text in json.loads(subtasks_json))


def merged(parts: Sequence[Rendered]) -> Rendered:
    """Join streams of one trajectory that were rendered or stored in at least one part.

    The values that all streams share come from a part with rendered streams, if there is one: a part that only states
    that a worker was lost has no states.
    """
    shared = next((part for part in parts if part.streams), parts[0])
    streams: dict[str, Sequence[Jpeg]] = {}
    rejected: dict[str, str] = {}
    geometry: dict[str, Geometry] = {}
    for part in parts:
        streams.update(part.streams)
        rejected.update(part.rejected)
        geometry.update(part.geometry)
    return replace(shared, streams=streams, rejected=rejected, geometry=geometry)


def _rendered(file: SealedFile, streams: Collection[str], geometry: Collection[str]) -> Rendered:
    """Read the named streams and geometry of a file, and all its other values."""
    quality = file.attributes["quality"]
    return Rendered(
        replay_mode=file.attributes["replay_mode"],
        state=file.array("state"),
        joint_state=file.array("joint_state"),
        action=file.array("action"),
        action_absolute=file.array("action_absolute"),
        streams={name: [*map(Jpeg, _unpacked(file, f"streams/{name}"))] for name in streams},
        rejected=json.loads(file.attributes["rejected"]),
        geometry={name: _geometry(file, f"geometry/{name}") for name in geometry},
        object_poses=file.array("object_poses") if "object_poses" in file.checksums else None,
        instances=file.attributes["instances"],
        quality=Quality(**quality) if quality else None,
        subtasks=_subtasks(file.attributes["subtasks"]),
    )


def _members(file: SealedFile, parent: str) -> list[str]:
    """List the groups of arrays directly below ``parent``, such as the ids of the streams."""
    return sorted({name.split("/")[1] for name in file.checksums if name.startswith(f"{parent}/")})


def _packed(parent: str, files: Sequence[bytes]) -> dict[str, NDArray[Any]]:
    """Join encoded images into an array of bytes and an array of the offsets at which the images end."""
    ends = np.cumsum([len(content) for content in files], dtype=np.int64)
    return {f"{parent}/bytes": np.frombuffer(b"".join(files), np.uint8), f"{parent}/ends": ends}


def _geometry(file: SealedFile, view: str) -> Geometry:
    matrices = {name: file.array(f"{view}/{name}") for name in MATRICES}
    maps = {name: _unpacked(file, f"{view}/{name}") for name in MAPS if f"{view}/{name}/bytes" in file.checksums}
    boxes = file.array(f"{view}/boxes") if f"{view}/boxes" in file.checksums else None
    return Geometry(**matrices, maps=maps, boxes=boxes)


def _unpacked(file: SealedFile, parent: str) -> list[bytes]:
    """Split the images that ``_packed`` joined."""
    packed = file.array(f"{parent}/bytes").tobytes()
    ends = file.array(f"{parent}/ends").tolist()
    return [packed[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]
