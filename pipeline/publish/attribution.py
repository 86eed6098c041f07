"""What the sources of a run's axes hold, and who made what its episodes show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain

from pipeline.axes import AXES, Axes, from_json
from pipeline.axes.base import Credit


def attributions(perturbations: Iterable[str]) -> dict[Credit, int]:
    """Everything of others' that episodes show, by kind and name, to how many of them show it.

    Args:
        perturbations: for each episode, the column of that name in the plan or the manifest. Nothing else is read.
    """
    shown = Counter(credit for text in perturbations for credit in {*chain(*(p.credits() for p in from_json(text)))})
    return dict(sorted(shown.items(), key=lambda one: (one[0].kind, *one[0])))


def counts(axes: Axes) -> dict[str, int]:
    """How many different textures and objects these axes draw from; what is not installed is fetched first.

    An axis that is not configured counts with its default sources.

    Raises:
        PipelineError: when a source cannot be had.
    """
    drawn = axes.drawn()
    offered = [(drawn.get(name) or axis()).offered() for name, axis in AXES.items()]
    return {kind: number for of_axis in offered for kind, number in of_axis.items()}
