"""What a view shows at one step of an episode: the scene perturbed, put into a state, drawn, and given its noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import Perturbation, PixelPerturbation, RenderPerturbation, of_layer
from pipeline.episode_schema import SCHEMA
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Frame


def frames_of(
    renderer: Renderer,
    state: Floats,
    site_alpha: NDArray[np.float32],
    perturbations: Sequence[Perturbation],
    step: int,
    views: Iterable[str] = tuple(SCHEMA.views),
) -> dict[str, Frame]:
    """Each view's frame (H, W, 3) uint8 RGB in the orientation of LIBERO's raw observations.

    Args:
        renderer: of the scene.
        state, site_alpha: (S,) and (nsite,) as ``Renderer.restore`` takes them.
        perturbations: of the episode; those of text and physics do nothing here.
        step: of the episode, for noise.
        views: which to show.
    """
    with renderer.perturbed(of_layer(perturbations, RenderPerturbation)):
        renderer.restore(state, site_alpha)
        return {view: noisy(renderer.frame(SCHEMA.views[view].camera), view, perturbations, step) for view in views}


def noisy(frame: Frame, view: str, perturbations: Sequence[Perturbation], step: int) -> Frame:
    """A clean frame of a view under the noise that an episode has at a step."""
    for noise in of_layer(perturbations, PixelPerturbation):
        if view in noise.views:
            frame = noise.apply(frame, step)
    return frame
