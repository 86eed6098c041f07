"""What the sources of a run's textures and objects hold, and who made the ones that its episodes show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from pipeline.axes import Axes, from_json
from pipeline.axes.background import BackgroundAxis, BackgroundPerturbation
from pipeline.axes.layout import LayoutAxis, LayoutPerturbation
from pipeline.catalogue.objects import models
from pipeline.catalogue.textures import catalogue


class Attribution(NamedTuple):
    """One texture or object that episodes show.

    Attributes:
        name: such as ``robosuite:clay.png`` or ``sweethome3d/scopia_teapot``.
        kind: ``texture`` or ``object``.
        licence: as its source states it.
        attribution: who made it and what was changed, where that is more than the licence says.
        episodes: how many show it.
    """

    name: str
    kind: str
    licence: str
    attribution: str
    episodes: int


def attributions(perturbations: Iterable[str]) -> list[Attribution]:
    """Every texture and object that episodes show, by kind and name.

    Args:
        perturbations: for each episode, the column of that name in the plan or the manifest. Nothing else is read.
    """
    shown: Counter[tuple[str, str, str, str]] = Counter()
    for text in perturbations:
        of_episode = set()
        for change in from_json(text):
            if isinstance(change, BackgroundPerturbation):
                of_episode |= {("texture", c.texture, c.licence, "") for c in change.coverings}
            elif isinstance(change, LayoutPerturbation):
                of_episode |= {("object", o.name, o.licence, o.attribution) for o in change.objects}
        shown.update(of_episode)
    return [
        Attribution(name, kind, licence, attribution, episodes)
        for (kind, name, licence, attribution), episodes in sorted(shown.items())
    ]


def counts(axes: Axes) -> dict[str, int]:
    """How many different textures and objects these axes draw from; what is not installed is fetched first.

    An axis that is not configured counts with its default sources.

    Raises:
        PipelineError: when a source cannot be had.
    """
    textures = catalogue((axes.background or BackgroundAxis()).sources).values()
    objects = models((axes.layout or LayoutAxis()).sources).values()
    return {
        "surfaces": len({texture.sha256 for texture in textures}),
        "procedural": sum(texture.source == "procedural" for texture in textures),
        "models": len({model.sha256 for model in objects}),
        "categories": len({model.category for model in objects}),
    }
