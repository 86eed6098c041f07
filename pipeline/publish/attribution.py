"""What the sources of a run's axes hold, and who made what its episodes show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain
from typing import NamedTuple

from pipeline.axes import AXES, Axes, from_json


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
    """Everything of others' that episodes show, by kind and name.

    Args:
        perturbations: for each episode, the column of that name in the plan or the manifest. Nothing else is read.
    """
    shown = Counter(credit for text in perturbations for credit in {*chain(*(p.credits() for p in from_json(text)))})
    return [
        Attribution(credit.name, credit.kind, credit.licence, credit.attribution, episodes)
        for credit, episodes in sorted(shown.items())
    ]


def counts(axes: Axes) -> dict[str, int]:
    """How many different textures and objects these axes draw from; what is not installed is fetched first.

    An axis that is not configured counts with its default sources.

    Raises:
        PipelineError: when a source cannot be had.
    """
    drawn = axes.drawn()
    offered = [(drawn.get(name) or axis()).offered() for name, axis in AXES.items()]
    return {kind: number for of_axis in offered for kind, number in of_axis.items()}
