"""Rendered trajectories on disk; episodes that show the same frames share one stream of them.

A trajectory has a folder, and in it a file for each set of streams that were rendered together.
"""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.config import RenderConfig
from pipeline.episode_schema import MAPS, MATRICES, SCHEMA
from pipeline.errors import PipelineError
from pipeline.identity import MAPS_RECIPE
from pipeline.seeding import digest
from pipeline.stores.sealed_file import SealedFile
from pipeline.stores.store import Store
from pipeline.types import Geometry, Quality, Rendered

_OF_THE_SCHEMA = {"views", "frame", *MATRICES, *MAPS, "object_poses"}
"""The schema's parts that say what files of a store hold."""


@dataclass(frozen=True)
class Shown:
    """What is stored of one trajectory's frames, in all its files.

    Attributes:
        made_by, device, replay_mode: as in the table.
        streams: ids of those that were rendered.
        rejected: stream id to the reason why it was not.
    """

    made_by: str
    device: str
    replay_mode: str
    streams: set[str] = field(default_factory=set)
    rejected: dict[str, str] = field(default_factory=dict)


class FrameStore(Store):
    """Frames under one folder.

    The columns of its table are ``device`` (what rendered, as OpenGL names it), ``replay_mode``, ``steps``, ``streams``
    (ids of those that were rendered) and ``rejected`` (JSON, stream id to the reason why it was not). A file's name is
    ``<trajectory id>/<digest of its streams>``.

    What was encoded otherwise than ``config`` says counts as missing.
    """

    step, stage, pattern = "encoding", "render", "*/*.h5"
    columns: ClassVar = {
        "device": pa.string(),
        "replay_mode": pa.string(),
        "steps": pa.int64(),
        "streams": pa.list_(pa.string()),
        "rejected": pa.string(),
    }

    def __init__(self, root: Path, config: RenderConfig):
        shown = [SCHEMA.model_dump(include=_OF_THE_SCHEMA), SCHEMA.image_rotation_deg]
        maps = {"recipe of maps": MAPS_RECIPE} if {*MAPS} & {*config.extras} else {}
        super().__init__(root, config.model_dump(mode="json"), {"episode schema": shown, **maps})

    @staticmethod
    def describe(file: SealedFile) -> dict[str, Any]:
        told = {name: file.attributes[name] for name in ("device", "replay_mode", "rejected")}
        return {**told, "steps": file.length("action"), "streams": file.groups("streams")}

    def folder(self, trajectory_id: str) -> Path:
        return self.root / trajectory_id

    def save(self, trajectory_id: str, rendered: Rendered, device: str) -> None:
        """Store what ``device``, as OpenGL names it, rendered of a trajectory, in a file of its own."""
        attributes = {
            "device": device,
            "replay_mode": rendered.replay_mode,
            "instances": list(rendered.instances),
            "rejected": json.dumps(dict(rendered.rejected), sort_keys=True),
            "quality": asdict(rendered.quality) if rendered.quality else None,
        }
        with self.created(file_name(trajectory_id, {*rendered.streams, *rendered.rejected}), attributes) as file:
            for name in ("state", "joint_state", "action"):
                file[name] = getattr(rendered, name)
            streams = file.create_group("streams")
            for stream_id, frames in sorted(rendered.streams.items()):
                _pack(streams.create_group(stream_id), frames)
            views = file.create_group("geometry")
            for geometry_id, geometry in sorted(rendered.geometry.items()):
                view = views.create_group(geometry_id)
                for name in MATRICES:
                    view[name] = getattr(geometry, name)
                for name, files in geometry.maps.items():
                    _pack(view.create_group(name), files)
            if rendered.object_poses is not None:
                file["object_poses"] = rendered.object_poses

    def load(self, trajectory_id: str, streams: Collection[str], geometry: Collection[str] = ()) -> Rendered:
        """Read the named streams of a trajectory.

        Args:
            streams: ids of streams, one at least.
            geometry: ids of the geometry to read with them.

        Raises:
            PipelineError: when a file is damaged, or one of the streams or its geometry is not there.
        """
        frames, views = set(streams), set(geometry)
        parts: list[Rendered] = []
        for name in self._files_of(trajectory_id):
            if not frames and not views:
                break
            with self.opened(name) as file:
                here = frames & set(file.groups("streams")), views & set(file.groups("geometry"))
                if any(here):
                    parts.append(_rendered(file, *here))
            frames, views = frames - here[0], views - here[1]
        if frames or views or not parts:
            raise PipelineError(
                f"streams {sorted(frames | views)} were not rendered",
                where=self.folder(trajectory_id),
                remedy="run the render stage again",
            )
        return merged(parts)

    def stored(self, trajectory_id: str, streams: Mapping[str, str], device: str) -> list[Rendered]:
        """What files hold of the named streams of a trajectory, each stream once; a damaged file counts as missing.

        Args:
            streams: id of a stream to the id of its geometry.
            device: which must have rendered them.
        """
        parts: list[Rendered] = []
        missing = set(streams)
        for name in self._files_of(trajectory_id):
            try:
                with self.opened(name) as file:
                    row = self.describe(file)
                    told = {*row["streams"], *json.loads(row["rejected"])}
                    here = missing & told if row["device"] == device else set()
                    if here:
                        frames = here & set(row["streams"])
                        part = _rendered(file, frames, {streams[stream] for stream in frames})
                        parts.append(replace(part, rejected={s: why for s, why in part.rejected.items() if s in here}))
            except PipelineError:
                continue
            missing -= here
        return parts

    def outdated_of(self, trajectories: Collection[str], device: str | None) -> Counter[str]:
        """``outdated`` for all files of some trajectories; with a device, those of another are counted too."""
        names = [name for name in self.names() if name.split("/")[0] in trajectories]
        reasons = self.outdated(names)
        rows = self.rows()
        for name in names if device else ():
            if name in rows and rows[name]["device"] != device:
                reasons[f"OpenGL device {rows[name]['device']}, here {device}"] += 1
        return reasons

    def motion(self, trajectory_id: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Action (K, 7) and state (K, 8) of a trajectory, without its frames.

        Raises:
            PipelineError: when a file is damaged, or none is there.
        """
        for name in self._files_of(trajectory_id):
            with self.opened(name) as file:
                if file.groups("streams"):
                    return file.array("action"), file.array("state")
        raise PipelineError("not rendered", where=self.folder(trajectory_id), remedy="run the render stage again")

    def _files_of(self, trajectory_id: str) -> list[str]:
        return sorted(f"{trajectory_id}/{path.stem}" for path in self.folder(trajectory_id).glob("*.h5"))


def file_name(trajectory_id: str, streams: Iterable[str]) -> str:
    """Of the file that holds these streams of a trajectory, or says that they were rejected."""
    return f"{trajectory_id}/{digest(*sorted(streams))[:16]}"


def shown_of(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Shown]:
    """Trajectory id to what its files hold, from their rows of the table."""
    shown: dict[str, Shown] = {}
    for name, row in rows.items():
        same = Shown(row["made_by"], row["device"], row["replay_mode"])
        one = shown.setdefault(name.split("/")[0], same)
        one.streams.update(row["streams"])
        one.rejected.update(json.loads(row["rejected"]))
    return shown


def merged(parts: Sequence[Rendered]) -> Rendered:
    """Streams of one trajectory that were rendered or stored apart; one part at least.

    What all streams share comes from a part that was rendered, where there is one: who stored that a worker was lost
    had no states to store.
    """
    return replace(
        next((part for part in parts if part.streams), parts[0]),
        streams={name: frames for part in parts for name, frames in part.streams.items()},
        rejected={name: why for part in parts for name, why in part.rejected.items()},
        geometry={name: view for part in parts for name, view in part.geometry.items()},
    )


def _rendered(file: SealedFile, streams: Collection[str], geometry: Collection[str]) -> Rendered:
    """What a file holds, of streams and geometry the named ones alone."""
    return Rendered(
        replay_mode=file.attributes["replay_mode"],
        state=file.array("state"),
        joint_state=file.array("joint_state"),
        action=file.array("action"),
        streams={name: _frames(file, f"streams/{name}") for name in streams},
        rejected=json.loads(file.attributes["rejected"]),
        geometry={name: _geometry(file, f"geometry/{name}") for name in geometry},
        object_poses=file.array("object_poses") if "object_poses" in file else None,
        instances=file.attributes["instances"],
        quality=Quality(**quality) if (quality := file.attributes["quality"]) else None,
    )


def _pack(group: h5py.Group, files: Sequence[bytes]) -> None:
    group["bytes"] = np.frombuffer(b"".join(files), np.uint8)
    group["ends"] = np.cumsum([len(one) for one in files])


def _geometry(file: SealedFile, view: str) -> Geometry:
    matrices = {name: file.array(f"{view}/{name}") for name in MATRICES}
    maps = {name: _frames(file, f"{view}/{name}") for name in MAPS if f"{view}/{name}/bytes" in file}
    return Geometry(**matrices, maps=maps)


def _frames(file: SealedFile, stream: str) -> list[bytes]:
    packed = file.array(f"{stream}/bytes").tobytes()
    ends = file.array(f"{stream}/ends").tolist()
    return [packed[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]
