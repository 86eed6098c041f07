"""Replayed trajectories on disk, verdicts included."""

import json
from dataclasses import asdict, fields
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.catalogue.scene_files import located, portable
from pipeline.stores.sealed_file import SealedFile
from pipeline.stores.store import Store
from pipeline.tables import columns_of
from pipeline.types import Quality, Scene, Start, Trajectory, Verdict


class TrajectoryStore(Store):
    """Trajectories under one folder.

    The columns of its table are ``kept`` and ``reason`` (the verdict), ``mode`` (origin of the actions) and ``steps``
    (number of executed actions). Further columns are ``resolved`` (JSON of the effects of physics perturbations in the
    scene) and those of ``Quality``.

    A file contains no path of the machine. Its bytes therefore do not depend on the place of the packages, and every
    machine can read it.
    """

    step = "physics"
    columns: ClassVar = {
        "kept": pa.bool_(),
        "reason": pa.string(),
        "mode": pa.string(),
        "steps": pa.int64(),
        "resolved": pa.string(),
        **{each.name: each.type for each in columns_of(Quality)},
    }

    @staticmethod
    def describe(file: SealedFile) -> dict[str, Any]:
        attributes = {name: file.attributes[name] for name in ("kept", "reason", "mode", "resolved")}
        return {**attributes, "steps": len(file.array("actions")), **(file.attributes["quality"] or {})}

    def save(self, trajectory: Trajectory) -> None:
        scene = trajectory.scene
        attributes = {
            **asdict(trajectory.verdict),
            "mode": trajectory.mode,
            "resolved": trajectory.resolved,
            "quality": asdict(trajectory.quality) if trajectory.quality else None,
            **scene.start.to_json(),
        }
        arrays: dict[str, NDArray[Any]] = {
            "model_xml": np.frombuffer(portable(trajectory.model_xml).encode(), np.uint8),
            "start": scene.state,
            "states": trajectory.states,
            "actions": trajectory.actions,
            "site_alpha": trajectory.site_alpha,
        }
        self.write(trajectory.trajectory_id, arrays, attributes)

    def load(self, trajectory_id: str) -> Trajectory:
        """Read a trajectory.

        Raises:
            PipelineError: when its file is missing, damaged or not up to date, or this machine lacks files of its
                scene.
        """
        with self.opened(trajectory_id) as file:
            attributes, quality = file.attributes, file.attributes["quality"]
            start = {each.name: attributes[each.name] for each in fields(Start) if each.name in attributes}
            scene = Scene(
                model_xml=located(file.array("model_xml").tobytes().decode(), self.path(trajectory_id)),
                state=file.array("start"),
                resolved=json.loads(attributes["resolved"]),
                start=Start.of(start),
            )
            return Trajectory(
                trajectory_id,
                attributes["mode"],
                scene,
                **{name: file.array(name) for name in ("states", "actions", "site_alpha")},
                verdict=Verdict(attributes["kept"], attributes["reason"]),
                quality=None if quality is None else Quality(**quality),
            )
