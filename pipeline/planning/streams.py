"""Which frames an episode shows: episodes that look the same share one stream of them. No simulator here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

from pipeline.axes import Perturbation, PixelPerturbation, RenderPerturbation, from_json, of_layer, to_json
from pipeline.episode_schema import SCHEMA
from pipeline.seeding import digest


@dataclass(frozen=True)
class Stream:
    """One view under the perturbations that show in it.

    Attributes:
        view: ``image`` or ``wrist_image``.
        perturbations: render and pixel layers, in the order they apply.
    """

    view: str
    perturbations: tuple[Perturbation, ...]

    @cached_property
    def stream_id(self) -> str:
        return digest("stream", self.view, to_json(self.perturbations))[:16]

    @property
    def changes(self) -> tuple[RenderPerturbation, ...]:
        """The perturbations that change its scene."""
        return of_layer(self.perturbations, RenderPerturbation)

    @property
    def geometry(self) -> Stream:
        """The view under what changes its surfaces alone: streams that have it in common share their geometry."""
        return Stream(self.view, tuple(change for change in self.changes if change.sees_otherwise))

    def scene(self, textures: bool = True) -> str:
        """What streams have in common that show the same scene, or the same one but for its textures."""
        return to_json([change for change in self.changes if textures or not change.paints])


@lru_cache(maxsize=65536)
def streams_of(perturbations_json: str) -> Mapping[str, Stream]:
    """View name to the stream that shows it, for an episode with these perturbations."""
    visible = [p for p in from_json(perturbations_json) if isinstance(p, RenderPerturbation | PixelPerturbation)]
    return {view: Stream(view, tuple(p for p in visible if view in p.views)) for view in SCHEMA.views}
