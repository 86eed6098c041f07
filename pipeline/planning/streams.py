"""Streams of frames: episodes that look equal share one stream. This module does not load the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

from pipeline.axes import Perturbation, PixelPerturbation, RenderPerturbation, from_json, of_layer, to_json
from pipeline.episode_schema import STANDARD
from pipeline.seeding import digest


@dataclass(frozen=True)
class Stream:
    """View under perturbations.

    Attributes:
        view: its name in ``schemas/episode.json``, such as ``image``.
        perturbations: perturbations in the order they apply. ``streams_of`` leaves out invisible ones;
            rendering ignores all others.
    """

    view: str
    perturbations: tuple[Perturbation, ...]

    @cached_property
    def stream_id(self) -> str:
        """Hash of the view and the perturbations, 16 hexadecimal digits."""
        return digest("stream", self.view, to_json(self.perturbations))[:16]

    @property
    def changes(self) -> tuple[RenderPerturbation, ...]:
        """Perturbations that change the rendered scene."""
        return of_layer(self.perturbations, RenderPerturbation)

    @property
    def geometry(self) -> Stream:
        """Stream under the changes of visible surfaces alone; streams that share it share their geometry."""
        return Stream(self.view, tuple(change for change in self.changes if change.shows_other_surfaces))

    def scene(self, textures: bool = True) -> str:
        """Return a key that streams of one scene share.

        Args:
            textures: true if scenes with different textures count as different scenes.
        """
        return to_json([change for change in self.changes if textures or not change.changes_only_textures])


@lru_cache(maxsize=65536)
def streams_of(perturbations_json: str, views: tuple[str, ...] = STANDARD.views) -> Mapping[str, Stream]:
    """Map the name of each view to the stream that shows it, for an episode with these perturbations."""
    visible = [p for p in from_json(perturbations_json) if isinstance(p, RenderPerturbation | PixelPerturbation)]
    streams = {}
    for view in views:
        streams[view] = Stream(view, tuple(p for p in visible if view in p.views))
    return streams
