"""Replayed trajectories on disk, verdicts included."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa

from pipeline.identity import fingerprint
from pipeline.run.store import Store
from pipeline.types import Trajectory, Verdict

_COLUMNS = {
    "kept": pa.bool_(),
    "reason": pa.string(),
    "mode": pa.string(),
    "steps": pa.int64(),
    "resolved": pa.string(),
}


class TrajectoryStore(Store):
    """Trajectories under one folder.

    The columns of its table are ``kept`` and ``reason`` (the verdict), ``mode`` (how the actions came about), ``steps``
    (how many were executed) and ``resolved`` (JSON of what physics perturbations did in the scene).
    """

    def __init__(self, root: Path):
        super().__init__(root, fingerprint("physics"), "replay", _COLUMNS, _describe)

    def save(self, trajectory: Trajectory) -> None:
        with self.created(trajectory.trajectory_id) as file:
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
            PipelineError: when its file is missing, damaged or not current.
        """
        with self.opened(trajectory_id) as file:
            return Trajectory(
                trajectory_id=trajectory_id,
                mode=str(file.attrs["mode"]),
                model_xml=file["model_xml"][()].tobytes().decode(),
                states=file["states"][()],
                actions=file["actions"][()],
                kept_mask=file["kept_mask"][()],
                site_alpha=file["site_alpha"][()],
                resolved=str(file.attrs["resolved"]),
                verdict=Verdict(bool(file.attrs["kept"]), str(file.attrs["reason"])),
            )


def verdicts_of(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Verdict]:
    """Trajectory id to verdict, from the rows of the table."""
    return {trajectory_id: Verdict(row["kept"], row["reason"]) for trajectory_id, row in rows.items()}


def _describe(file: h5py.File) -> dict[str, Any]:
    # Every dataset is looked up, so that a file that lacks one is made again.
    lengths = {name: len(file[name]) for name in ("model_xml", "states", "actions", "kept_mask", "site_alpha")}
    return {
        "kept": bool(file.attrs["kept"]),
        "reason": str(file.attrs["reason"]),
        "mode": str(file.attrs["mode"]),
        "steps": lengths["actions"],
        "resolved": str(file.attrs["resolved"]),
    }
