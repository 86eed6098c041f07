"""Some episodes rendered anew: is what the store and the datasets have the right picture, and the right way up?

The process is another than the one that rendered the frames, and the pictures are made from the trajectory's states.
Noise and turning are done here once more, by other code than that of the run (``rendering/render.py``).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from pipeline import gl
from pipeline.axes import PixelPerturbation, RenderPerturbation, from_json, of_layer
from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.formats.read_back import Fault
from pipeline.images.jpeg import encode
from pipeline.rendering.renderer import LastScene
from pipeline.types import Frame
from pipeline.validation.case import Case

PSNR_DB = 25.0
"""Least PSNR of a frame to a fresh rendering: far below what JPEG costs, far above what another frame reaches."""

BEFORE = 5
"""A frame that came late would show what is so many steps before; in fewer, little moves."""


def witnesses(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The clean episode of every task, and one episode of every axis and combination."""
    chosen = {
        (row["suite"], row["task"]) if row["role"] == "twin" else row["axis"]: row["episode_id"]
        for row in rows
        if row["kept"]
    }
    return list(chosen.values())


def rendered(case: Case, config: RenderConfig, opened: LastScene) -> Iterator[Fault]:
    """The first and the middle frame of every view, against fresh renderings turned by numpy, as they are not there.

    Where the same device renders, the stored frame must be the same file. On another, and in the datasets, the fresh
    rendering must be the nearest of all pictures that may have taken its place.
    """
    exact = case.row["gl_device"] == gl.choose().device
    for step in dict.fromkeys((0, len(case.made) // 2)):
        fresh = _raw(case, opened, step)
        former = _raw(case, opened, step - BEFORE) if step > BEFORE else {}
        for view in SCHEMA.views:
            name = f"{view} of step {step}"
            stored = case.made.frames[view][step]
            again = encode(_turned(fresh[view]), config)
            same = exact and stored == again
            for seen in case.seen:
                if seen.view != view or (same and seen.dataset == "frames"):
                    continue
                right = f"{name} turned by {SCHEMA.image_rotation_deg} degrees"
                nearest, reached_db = _nearest(seen.frames[step], right, view, fresh, former.get(view))
                if nearest != right or reached_db < PSNR_DB:
                    what = f"{name} is nearest to {nearest}, {reached_db:.1f} dB"
                    yield case.finding(seen.dataset, what, right)
                elif exact and seen.dataset == "frames":
                    what = f"{name} is another file than a fresh rendering, {reached_db:.1f} dB apart"
                    expected = f"the same file, as both were rendered by {case.row['gl_device']}"
                    yield case.finding(seen.dataset, what, expected)


def _nearest(
    frame: Frame, right: str, view: str, fresh: Mapping[str, Frame], former: Frame | None
) -> tuple[str, float]:
    could_be = {
        right: _turned(fresh[view]),
        f"{view} not turned": fresh[view],
        f"{view} upside down": fresh[view][::-1],
        f"{view} mirrored": fresh[view][:, ::-1],
        "a black frame": np.zeros_like(frame),
        **{f"{other}, turned": _turned(raw) for other, raw in fresh.items() if other != view},
    }
    if former is not None:
        could_be[f"{view} of {BEFORE} steps before"] = _turned(former)
    reached = {name: float(cv2.PSNR(frame, np.ascontiguousarray(one))) for name, one in could_be.items()}
    nearest = max(reached, key=reached.__getitem__)
    return nearest, reached[nearest]


def _turned(raw: Frame) -> Frame:
    return np.ascontiguousarray(np.rot90(raw, SCHEMA.image_rotation_deg // 90))


def _raw(case: Case, opened: LastScene, step: int) -> dict[str, Frame]:
    """View to its frame before a step, in the orientation of LIBERO's raw observations."""
    renderer, changes = opened.renderer(case.trajectory.model_xml), from_json(case.row["perturbations"])
    with renderer.perturbed(of_layer(changes, RenderPerturbation)):
        renderer.restore(case.trajectory.states[step], case.trajectory.site_alpha[step])
        frames = {view: renderer.frame(spec.camera) for view, spec in SCHEMA.views.items()}
    for noise in of_layer(changes, PixelPerturbation):
        frames |= {view: noise.apply(frames[view], step) for view in noise.views}
    return frames
