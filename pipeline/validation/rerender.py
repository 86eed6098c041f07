"""Comparison of stored frames with new renderings of some episodes, to find wrong or wrongly rotated frames.

The frames are rendered again from the trajectory's states. Noise and rotation are applied by code of this module, not
by the run's (``rendering/render.py``).
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
from pipeline.physics.subtasks import subtasks
from pipeline.rendering.renderer import LastScene
from pipeline.types import Frame
from pipeline.validation.case import Case

PSNR_DB = 25.0
"""Least PSNR of a frame to a fresh rendering: far below the PSNR after JPEG, far above the PSNR of another frame."""

BEFORE = 5
"""Steps by which a delayed frame is assumed to be late; in fewer steps, little moves."""


def choose_rerendered(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Choose a clean episode of every task, and one episode of every axis and combination."""
    chosen: dict[object, str] = {}
    for row in rows:
        if row["kept"]:
            group = (row["suite"], row["task"]) if row["role"] == "twin" else row["axis"]
            chosen[group] = row["episode_id"]
    return list(chosen.values())


def compare_frames(case: Case, render_config: RenderConfig, opened: LastScene) -> Iterator[Fault]:
    """Compare the first and the middle frame of every view with fresh renderings, which numpy rotates.

    If the same device renders, the stored frame must be the same file. On another device, and in the datasets, the
    fresh rendering must be the nearest of all pictures that could have been stored by mistake.
    """
    exact = case.row["gl_device"] == gl.choose().device
    for step in dict.fromkeys((0, len(case.episode) // 2)):
        fresh = _raw(case, opened, render_config, step)
        former = _raw(case, opened, render_config, step - BEFORE) if step > BEFORE else {}
        for view in fresh:
            name = f"{view} of step {step}"
            stored = case.episode.frames[view][step]
            again = encode(_turned(fresh[view]), render_config.jpeg_quality)
            same = exact and stored == again
            for shown_view in case.shown_views:
                if shown_view.view != view or (same and shown_view.dataset == "frames"):
                    continue
                right = f"{name} turned by {SCHEMA.image_rotation_deg} degrees"
                nearest, reached_db = _nearest(shown_view.frames[step], right, view, fresh, former.get(view))
                if nearest != right or reached_db < PSNR_DB:
                    what = f"{name} is nearest to {nearest}, {reached_db:.1f} dB"
                    yield case.finding(shown_view.dataset, what, right)
                elif exact and shown_view.dataset == "frames":
                    what = f"{name} is another file than a fresh rendering, {reached_db:.1f} dB apart"
                    expected = f"the same file, because {case.row['gl_device']} rendered both"
                    yield case.finding(shown_view.dataset, what, expected)


def compare_subtasks(case: Case) -> Iterator[Fault]:
    """Compute the subtasks again from the states of the replay alone, and compare them with the stored ones."""
    expected = subtasks(case.trajectory, case.task)
    if tuple(case.episode.subtasks) != expected:
        yield case.finding("frames", f"subtasks {list(case.episode.subtasks)}", list(expected))


def _nearest(
    frame: Frame, right: str, view: str, fresh: Mapping[str, Frame], former: Frame | None
) -> tuple[str, float]:
    candidates = {
        right: _turned(fresh[view]),
        f"{view} not turned": fresh[view],
        f"{view} upside down": fresh[view][::-1],
        f"{view} mirrored": fresh[view][:, ::-1],
        "a black frame": np.zeros_like(frame),
        **{f"{name}, turned": _turned(raw) for name, raw in fresh.items() if name != view},
    }
    if former is not None:
        candidates[f"{view} of {BEFORE} steps before"] = _turned(former)
    psnr_db = {name: float(cv2.PSNR(frame, np.ascontiguousarray(image))) for name, image in candidates.items()}
    nearest = max(psnr_db, key=psnr_db.__getitem__)
    return nearest, psnr_db[nearest]


def _turned(raw: Frame) -> Frame:
    return np.ascontiguousarray(np.rot90(raw, SCHEMA.image_rotation_deg // 90))


def _raw(case: Case, opened: LastScene, render_config: RenderConfig, step: int) -> dict[str, Frame]:
    """Render the frame of each view before a step, in the orientation of LIBERO's raw observations."""
    renderer = opened.renderer(case.trajectory.model_xml, render_config.size_px)
    changes = from_json(case.row["perturbations"])
    with renderer.perturbed(of_layer(changes, RenderPerturbation)):
        renderer.restore(case.trajectory.states[step], case.trajectory.site_alpha[step])
        frames = {view: renderer.frame(spec.camera) for view, spec in render_config.content.cameras.items()}
    for noise in of_layer(changes, PixelPerturbation):
        frames |= {view: noise.apply(frames[view], step) for view in noise.views}
    return frames
