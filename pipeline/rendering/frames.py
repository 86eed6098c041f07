"""From a stored state to the frames of an episode: perturb, restore, render, add noise, turn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import PixelPerturbation, RenderPerturbation, of_layer
from pipeline.episode_schema import SCHEMA
from pipeline.images.jpeg import to_policy
from pipeline.planning.streams import Stream
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Frame


def frames_of(
    renderer: Renderer, state: Floats, site_alpha: NDArray[np.float32], streams: Sequence[Stream], step: int
) -> list[Frame]:
    """One frame (H, W, 3) uint8 RGB for each stream, turned by 180 degrees as policies see it.

    A view is rendered once: streams that differ in noise alone share its clean frame. Whoever renders many steps keeps
    the scene perturbed meanwhile (``Renderer.perturbed``).

    Args:
        renderer: of the scene.
        state, site_alpha: (S,) and (nsite,) as ``Renderer.restore`` takes them.
        streams: one at least, all with the same render perturbations.
        step: of the episode; random noise depends on it.
    """
    with renderer.perturbed(changes_of(streams[0])):
        renderer.restore(state, site_alpha)
        views = dict.fromkeys(stream.view for stream in streams)
        clean = {view: renderer.frame(SCHEMA.views[view].camera) for view in views}
    return [to_policy(_noisy(clean[stream.view], stream, step)) for stream in streams]


def changes_of(stream: Stream) -> tuple[RenderPerturbation, ...]:
    """The perturbations of a stream that change its scene."""
    return of_layer(stream.perturbations, RenderPerturbation)


def _noisy(frame: Frame, stream: Stream, step: int) -> Frame:
    for noise in of_layer(stream.perturbations, PixelPerturbation):
        if stream.view in noise.views:
            frame = noise.apply(frame, step)
    return frame
