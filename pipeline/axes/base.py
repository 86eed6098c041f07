"""What every axis of perturbation has in common.

An axis comes as a pair of small frozen models in one file:

* ``XAxis`` is the axis as configured, its ranges, and draws: ``sample(rng, task, variant) -> XPerturbation``.
* ``XPerturbation`` is one drawn change with every parameter, and acts: ``apply(...)`` on what its layer
  touches (text: the instruction; pixels: a clean frame; render and physics: the MuJoCo model).
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar

from pydantic import BaseModel, ConfigDict


class Layer(IntEnum):
    """The cheapest thing that has to be made again when an axis changes; lower is cheaper."""

    TEXT = 0
    PIXELS = 1
    RENDER = 2
    PHYSICS = 3


class Frozen(BaseModel):
    """A record that cannot change and refuses fields it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Perturbation(Frozen):
    """One change on one axis, with all of its parameters; JSON in and out through pydantic.

    Attributes:
        axis: name of the axis, the discriminator when a perturbation is read back.
        component: which of the axis's components was drawn.
    """

    axis: str
    component: str

    layer: ClassVar[Layer]
    views: ClassVar[frozenset[str]]
    """The views of ``schemas/episode.json`` whose frames this can change; empty for text."""
