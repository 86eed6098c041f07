"""Trajectories and rendered episodes on disk: one HDF5 file for each trajectory, whole or not there.

A file is done when it exists, opens and was made under the versions that run now; anything else is made again.
Names are content hashes, so a changed plan never picks up a file that was made for something else, and still finds
every file that it shares with the plan before it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.config import RenderConfig
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.seeding import digest
from pipeline.types import Trajectory, Verdict
from pipeline.versions import fingerprint


class TrajectoryStore:
    """Replayed trajectories, verdict included, under one folder."""

    def __init__(self, root: Path):
        self.root = root

    def path(self, trajectory_id: str) -> Path:
        return self.root / f"{trajectory_id}.h5"

    def save(self, trajectory: Trajectory) -> None:
        with replaced(self.path(trajectory.trajectory_id)) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["made_by"] = fingerprint()
            file.attrs["mode"] = trajectory.mode
            file.attrs["kept"] = trajectory.verdict.kept
            file.attrs["reason"] = trajectory.verdict.reason
            file.attrs["resolved"] = trajectory.resolved
            file["model_xml"] = np.frombuffer(trajectory.model_xml.encode(), np.uint8)
            file["states"] = trajectory.states
            file["actions"] = trajectory.actions
            file["kept_mask"] = trajectory.kept_mask
            file.create_dataset("site_alpha", data=trajectory.site_alpha, compression="gzip")

    def load(self, trajectory_id: str) -> Trajectory:
        """Read a trajectory back.

        Raises:
            PipelineError: when its file is missing, damaged or of other versions.
        """
        with _opened(self.path(trajectory_id), fingerprint(), "replay") as file:
            return Trajectory(
                trajectory_id=trajectory_id,
                mode=str(file.attrs["mode"]),
                model_xml=file["model_xml"][()].tobytes().decode(),
                states=file["states"][()],
                actions=file["actions"][()],
                kept_mask=file["kept_mask"][()],
                site_alpha=file["site_alpha"][()],
                resolved=str(file.attrs["resolved"]),
                verdict=_verdict(file),
            )

    def verdict(self, trajectory_id: str) -> Verdict | None:
        """The verdict on a trajectory, or None when it still has to be replayed."""
        try:
            with _opened(self.path(trajectory_id), fingerprint(), "replay") as file:
                return _verdict(file)
        except PipelineError:
            return None

    def outcome(self, trajectory_id: str) -> tuple[str, int, str]:
        """The replay's mode, how many actions were executed, and JSON of what physics perturbations came to."""
        with _opened(self.path(trajectory_id), fingerprint(), "replay") as file:
            return str(file.attrs["mode"]), len(file["actions"]), str(file.attrs["resolved"])


@dataclass(frozen=True)
class Rendered:
    """Everything that a policy may see of one trajectory.

    Attributes:
        replay_mode: how the trajectory's actions came about.
        state: (K, 8), joint_state: (K, 7), action: (K, 7); see ``schemas/episode.json``.
        streams: stream id to K encoded frames.
        rejected: stream id to the reason why it was not rendered.
    """

    replay_mode: str
    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    action: NDArray[np.float32]
    streams: Mapping[str, Sequence[bytes]] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)


class FrameStore:
    """Rendered trajectories under one folder; episodes that show the same frames share one stream of them.

    Args:
        root: the folder.
        config: how frames are encoded; what was encoded otherwise counts as missing.
        device: what renders now, as OpenGL names it; with it, what another device rendered counts as missing too.
    """

    def __init__(self, root: Path, config: RenderConfig, device: str | None = None):
        self.root = root
        self._device = device
        self._made_by = digest(fingerprint(), config.model_dump())[:16]

    def path(self, trajectory_id: str) -> Path:
        return self.root / f"{trajectory_id}.h5"

    def save(self, trajectory_id: str, rendered: Rendered) -> None:
        with replaced(self.path(trajectory_id)) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["made_by"] = self._made_by
            file.attrs["device"] = self._device or ""
            file.attrs["replay_mode"] = rendered.replay_mode
            for name in ("state", "joint_state", "action"):
                file[name] = getattr(rendered, name)
            for stream, frames in sorted(rendered.streams.items()):
                file[f"streams/{stream}/bytes"] = np.frombuffer(b"".join(frames), np.uint8)
                file[f"streams/{stream}/ends"] = np.cumsum([len(frame) for frame in frames])
            file.attrs["rejected"] = json.dumps(rendered.rejected, sort_keys=True)

    def streams(self, trajectory_id: str) -> set[str]:
        """The streams that are there or were rejected; none when the file is missing, damaged or of other versions."""
        try:
            with _opened(self.path(trajectory_id), self._made_by, "render") as file:
                same_device = self._device in (None, file.attrs["device"])
                return set(file["streams"]) | set(json.loads(file.attrs["rejected"])) if same_device else set()
        except PipelineError:
            return set()

    def rejected(self, trajectory_id: str) -> dict[str, str]:
        """Stream id to the reason why it was not rendered; empty when nothing of the trajectory was."""
        try:
            with _opened(self.path(trajectory_id), self._made_by, "render") as file:
                return dict(json.loads(file.attrs["rejected"]))
        except PipelineError:
            return {}

    def device(self, trajectory_id: str) -> str:
        """What rendered a trajectory, as OpenGL names it."""
        with _opened(self.path(trajectory_id), self._made_by, "render") as file:
            return str(file.attrs["device"])

    def load(self, trajectory_id: str, streams: Sequence[str]) -> Rendered:
        """Read the named streams of a trajectory.

        Raises:
            PipelineError: when the file or one of the streams is not there.
        """
        with _opened(self.path(trajectory_id), self._made_by, "render") as file:
            missing = set(streams) - set(file["streams"])
            if missing:
                raise PipelineError(
                    f"streams {sorted(missing)} were not rendered",
                    where=self.path(trajectory_id),
                    remedy="run the render stage again",
                )
            return Rendered(
                replay_mode=str(file.attrs["replay_mode"]),
                state=file["state"][()],
                joint_state=file["joint_state"][()],
                action=file["action"][()],
                streams={name: _frames(file[f"streams/{name}"]) for name in streams},
            )


def _frames(stream: h5py.Group) -> list[bytes]:
    packed = stream["bytes"][()].tobytes()
    ends = stream["ends"][()].tolist()
    return [packed[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def _verdict(file: h5py.File) -> Verdict:
    return Verdict(bool(file.attrs["kept"]), str(file.attrs["reason"]))


@contextmanager
def _opened(path: Path, made_by: str, stage: str) -> Iterator[h5py.File]:
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("made_by") != made_by:
                raise PipelineError(
                    "made under other versions or settings", where=path, remedy=f"run the {stage} stage again"
                )
            yield file
    except (OSError, KeyError) as error:
        raise PipelineError("missing or damaged", where=path, remedy=f"run the {stage} stage again") from error
