"""Some episodes' first frames rendered anew: is what the datasets have the right camera's, and the right way up?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.axes import PixelPerturbation, RenderPerturbation, of_layer
from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import Fault
from pipeline.rendering.renderer import LastScene
from pipeline.run.streams import streams_of
from pipeline.types import Frame, Trajectory
from pipeline.validation.checks import Case, psnr_db

PSNR_DB = 25.0
"""Least PSNR of a first frame to a fresh rendering: far below what JPEG costs, far above what another frame reaches."""


def witnesses(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The clean episode of every task, and one episode of every axis and combination."""
    chosen = {
        (row["suite"], row["task"]) if row["role"] == "twin" else row["axis"]: row["episode_id"]
        for row in rows
        if row["kept"]
    }
    return list(chosen.values())


def rendered(case: Case, opened: LastScene) -> Iterator[Fault]:
    """The first frame of every view, against a fresh rendering turned by numpy: not the way frames are turned there."""
    turns = SCHEMA.image_rotation_deg // 90
    raw = _raw(case.trajectory, case.row["perturbations"], opened)
    for view in SCHEMA.views:
        right = f"{view} turned by {SCHEMA.image_rotation_deg} degrees"
        could_be = {
            right: np.rot90(raw[view], turns),
            f"{view} not turned": raw[view],
            f"{view} upside down": raw[view][::-1],
            f"{view} mirrored": raw[view][:, ::-1],
            **{f"{other}, turned": np.rot90(frame, turns) for other, frame in raw.items() if other != view},
        }
        for copy in case.whole:
            shown = copy.frames[view, 0]
            near = {name: psnr_db(shown, np.ascontiguousarray(frame)) for name, frame in could_be.items()}
            nearest = max(near, key=near.__getitem__)
            if nearest != right or near[right] < PSNR_DB:
                yield case.finding(copy.dataset, f"{view} is nearest to {nearest}, {near[nearest]:.1f} dB", right)


def _raw(trajectory: Trajectory, perturbations: str, opened: LastScene) -> dict[str, Frame]:
    """View to its first frame in the orientation of LIBERO's raw observations."""
    frames = {}
    renderer = opened.renderer(trajectory.model_xml)
    for view, stream in streams_of(perturbations).items():
        with renderer.perturbed(of_layer(stream.perturbations, RenderPerturbation)):
            renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
            frame = renderer.frame(SCHEMA.views[view].camera)
        for noise in of_layer(stream.perturbations, PixelPerturbation):
            frame = noise.apply(frame, 0)
        frames[view] = frame
    return frames
