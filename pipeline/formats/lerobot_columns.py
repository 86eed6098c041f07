"""The columns of a LeRobot dataset, as lerobot describes them. Light to import."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

from pipeline.episode_schema import MAPS, MATRICES, SCHEMA, MatrixSpec, PosesSpec, named
from pipeline.types import Extra

Frames = Literal["video", "images"]
"""``video`` is H.264 made from the stored frames; ``images`` are the stored JPEG files, three times as large."""

EPISODE_ID = "episode_id"
"""A column of every frame, because lerobot's tools to delete, split and merge number episodes anew and leave
``meta/provenance.parquet`` behind: with it, an episode is still found in the manifest."""

INSTANCES, OBJECT_POSES = "instances", "object_poses"
"""Columns of every frame with extras: a JSON list of names, and the poses of what it names, row by row."""


def camera_column(view: str, name: str) -> str:
    """The column of every frame with a matrix (row by row) or a map (PNG in base64) of a view.

    Maps are text, and no name begins with ``observation``, because lerobot's policies take such columns and all images.
    """
    return f"{SCHEMA.views[view].lerobot_camera}.{name}"


def geometry_columns(extras: Collection[Extra] = ()) -> dict[str, dict[str, Any]]:
    """lerobot's description of the columns of cameras and extras."""
    columns: dict[str, dict[str, Any]] = {}
    text = {"dtype": "string", "shape": (1,), "names": None}
    for view in SCHEMA.views:
        columns |= {camera_column(view, name): _flat(getattr(SCHEMA, name)) for name in MATRICES}
        columns |= {camera_column(view, name): dict(text) for name in MAPS if name in extras}
    if "object_poses" in extras:
        columns[OBJECT_POSES] = _flat(SCHEMA.object_poses)
    return columns | ({INSTANCES: text} if named(extras) else {})


def _flat(spec: MatrixSpec) -> dict[str, Any]:
    rows, columns = spec.shape
    heads = spec.names if isinstance(spec, PosesSpec) else range(columns)
    names = [f"{row}_{head}" for row in range(rows) for head in heads]
    return {"dtype": spec.dtype, "shape": (rows * columns,), "names": names}


def features(frames: Frames, extras: Collection[Extra] = ()) -> dict[str, dict[str, Any]]:
    """lerobot's description of the columns."""
    dtype = {"video": "video", "images": "image"}[frames]
    frame = {"dtype": dtype, "shape": SCHEMA.frame.shape, "names": list(SCHEMA.frame.names)}
    columns = {view.lerobot_key: dict(frame) for view in SCHEMA.views.values()}
    for vector in (SCHEMA.state, SCHEMA.joint_state, SCHEMA.action):
        columns[vector.lerobot_key] = {"dtype": vector.dtype, "shape": vector.shape, "names": list(vector.names)}
    return columns | {EPISODE_ID: {"dtype": "string", "shape": (1,), "names": None}} | geometry_columns(extras)
