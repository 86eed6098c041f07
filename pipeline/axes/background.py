"""Background: what the room and the working surface are made of. Render layer; both views change.

The new surface is written into the texture that is there, resampled to its size, so that geometry, reflections and
the way it is laid over a table or a wall stay LIBERO's. Half of the draws show the new surfaces in colours of their
own, as LIBERO-Plus's tests do. The other half goes by level: 1 keeps the average colour of what is replaced and changes
the pattern, 5 shows the new one's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Credit, Frozen, RenderPerturbation, Share, pick
from pipeline.catalogue import textures
from pipeline.catalogue.data_maps import DATA_MAPS
from pipeline.catalogue.procedural import COLOUR_MAPS
from pipeline.catalogue.texture_sources import Source, Texture, keep
from pipeline.errors import PipelineError
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Frame, Task

if TYPE_CHECKING:
    import mujoco

Component = Literal["theme", "surface"]
Part = Literal["wall", "floor", "cupboard", "surface"]

MATERIALS: dict[Part, dict[str, int]] = {
    "wall": {"walls_mat": 1},
    "floor": {"floorplane": 1},
    # What closes the kitchen's view where the other arenas show a wall.
    "cupboard": {"kitchen_background": 1},
    # Tabletop and kitchen, living room, study; where there is no table, the floor is worked on.
    "surface": {"table_texture": 1, "living_room_table": 2, "desk": 4, "floorplane": 1},
}
"""The materials of LIBERO's five arenas (`scenes/*_base_style.xml`) that make up each part: the first that is shown.
With each, how often a texture is repeated across the material's own, as the top of a modelled table is but a small
piece of its unfolded skin."""

PARTS: dict[Component, tuple[Part, ...]] = {"theme": ("wall", "floor", "cupboard", "surface"), "surface": ("surface",)}
"""What a draw names a texture for. Every theme test of LIBERO-Plus names one for a wall and one to work on."""

_DARKEST, _BRIGHTEST = 40.0, 205.0
"""Grey levels that the average of a surface is kept within, so that no light makes it a black or a white area."""


class Covering(Frozen):
    """A texture on one part of the scene.

    Attributes:
        part: where; a part that the scene does not have is left out. Where the floor is worked on, it is the surface.
        texture: name in the sources of :mod:`pipeline.catalogue.textures`.
        licence: as the texture's source states it.
        sha256: of the texture.
        quarter_turns: how often it is turned by 90 degrees, counter-clockwise.
    """

    part: Part
    texture: str
    licence: str
    sha256: str
    quarter_turns: Annotated[int, Field(ge=0, le=3)] = 0


class BackgroundPerturbation(RenderPerturbation):
    """New walls, floor and working surface, or a new working surface alone.

    Attributes:
        coverings: which texture goes where.
        colour_scale: how far the average colour goes from that of the replaced texture (0) to the new one's own (1).
    """

    axis: Literal["background"] = "background"
    component: Component
    coverings: tuple[Covering, ...]
    colour_scale: Share

    fields: ClassVar[tuple[str, ...]] = ("tex_data",)
    measure: ClassVar[str] = "0 where an image's name or bytes are those of a test task's, else 1"
    clearance: ClassVar[float] = 1.0

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the coverings into the model's textures.

        Raises:
            PipelineError: when a texture is not there any more, or nothing in the scene is known by its material.
        """
        # By texture, as two parts may be one: the last then stands for both.
        skins = ((covering, skin_of(model, covering.part)) for covering in self.coverings)
        shown = {skin.texture: (covering, skin) for covering, skin in skins if skin}
        if not shown:
            raise PipelineError(
                f"the scene shows no {' or '.join(c.part for c in self.coverings)}",
                where="model",
                expected=f"one of the materials {sorted({name for names in MATERIALS.values() for name in names})}",
                remedy="use a scene of LIBERO's arenas",
            )
        for covering, skin in shown.values():
            image = np.rot90(textures.pixels(covering.texture, covering.sha256), covering.quarter_turns)
            _cover(model, skin, image, self.colour_scale)

    def distances(self, test: TestSet, task: Task) -> Floats:
        """The same to all test tasks: whether any shows one of the images, whatever it shows it on."""
        shown = _images_of(test)
        known = (textures.normalise(c.texture) in shown or c.sha256 in textures.test_images() for c in self.coverings)
        return np.full(len(test.of("background")), 0.0 if any(known) else 1.0)

    def apart(self, others: Sequence[BackgroundPerturbation]) -> Floats:
        """0 where both show one of the images, else 1."""
        own = {covering.sha256 for covering in self.coverings}
        return np.array([float(own.isdisjoint(c.sha256 for c in other.coverings)) for other in others])

    def credits(self) -> frozenset[Credit]:
        return frozenset(Credit(c.texture, "texture", c.licence, "") for c in self.coverings)


class BackgroundAxis(Axis):
    """What to draw from.

    Attributes:
        components: which of them, each as often as the other.
        sources: where textures come from. ``metaworld`` and ``gymnasium-robotics`` are wheels that pip downloads
            (63 MB) when a plan first draws from them; the others are there.
        own_colours: how often a draw shows all its textures in their own colours, whatever its level.
        map_share: how often such a draw has a data map on the working surface, as 751 of LIBERO-Plus's 1,076
            background tests do, where ``sources`` name ``procedural``.
        image_share: how often an image is drawn rather than a procedural colour map, of which there are many more.
        colour_scale: for each level, how much of the new texture's own average colour shows in the other draws.
    """

    draws: ClassVar = (BackgroundPerturbation,)

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = ("theme", "surface")
    sources: Annotated[tuple[Source, ...], Field(min_length=1)] = ("libero", "robosuite", "procedural")
    own_colours: Share = 0.5
    map_share: Share = 0.7
    image_share: Share = 0.3
    colour_scale: ByLevel[Share] = (0.2, 0.4, 0.6, 0.8, 1.0)

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> BackgroundPerturbation:
        component = pick(rng, self.components)
        level = self.draw_level(rng)
        own_colours = rng.random() < self.own_colours
        return BackgroundPerturbation(
            component=component,
            level=level,
            coverings=tuple(self._draw_covering(rng, part, own_colours) for part in PARTS[component]),
            colour_scale=1.0 if own_colours else self.colour_scale[level - 1],
        )

    def offered(self) -> dict[str, int]:
        found = textures.catalogue(self.sources).values()
        return {
            "surfaces": len({texture.sha256 for texture in found}),
            "procedural": sum(texture.source == "procedural" for texture in found),
        }

    def _draw_covering(self, rng: np.random.Generator, part: Part, own_colours: bool) -> Covering:
        colour_maps, data_maps, images = (_offered(self.sources, (*kind,)) for kind in (COLOUR_MAPS, DATA_MAPS, [None]))
        if part == "surface" and own_colours and data_maps and rng.random() < self.map_share:
            texture = pick(rng, data_maps)
        elif images and (rng.random() < self.image_share or not colour_maps):
            texture = pick(rng, images)
        else:
            texture = pick(rng, colour_maps)
        keep(texture)
        shown = {"texture": texture.name, "licence": texture.licence, "sha256": texture.sha256}
        return Covering(part=part, **shown, quarter_turns=int(rng.integers(4)))


@cache
def _offered(sources: tuple[Source, ...], families: tuple[str | None, ...]) -> list[Texture]:
    """The textures of some families, all images being of the family None."""
    return [texture for texture in textures.catalogue(sources).values() if texture.family in families]


@cache
def _images_of(test: TestSet) -> frozenset[str]:
    """The images that test tasks show, by normalised name."""
    files = (other.parameters.get(part) for other in test.of("background") for part in ("surface", "wall"))
    return frozenset(textures.normalise(file) for file in files if isinstance(file, str))


class Skin(NamedTuple):
    """A texture of a model and how often a covering is repeated across it."""

    texture: int
    repeats: int


def skin_of(model: mujoco.MjModel, part: Part) -> Skin | None:
    """What makes up a part of the scene; None where the scene has no such part."""
    for name, repeats in MATERIALS[part].items():
        try:
            material = model.material(name)
        except KeyError:
            continue
        # A material lists a texture for each of ten roles, -1 for none; LIBERO's have one, the colour.
        if material.texid.max() >= 0 and (model.geom_matid == material.id).any():
            return Skin(int(material.texid.max()), repeats)
    return None


def _cover(model: mujoco.MjModel, skin: Skin, image: Frame, colour_scale: float) -> None:
    """Put ``image`` (H, W, 3) in the place of a texture of the model."""
    import cv2  # takes long, and every process of a run imports the axes

    height, width, channels = (int(n[skin.texture]) for n in (model.tex_height, model.tex_width, model.tex_nchannel))
    start = int(model.tex_adr[skin.texture])
    there = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    size = (width // skin.repeats, height // skin.repeats)
    interpolation = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
    piece = np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)
    own, former = _mean(piece).clip(1), _mean(there)
    wanted = former + colour_scale * (own - former)
    wanted *= np.clip(wanted.mean(), _DARKEST, _BRIGHTEST) / wanted.mean()
    changed = _recoloured(own, wanted, piece.max(axis=(0, 1)))
    piece = np.asarray(cv2.LUT(piece, np.rint(changed).clip(0, 255).astype(np.uint8)[None]), np.uint8)
    for top, left in product(range(0, height, size[1]), range(0, width, size[0])):
        there[top : top + size[1], left : left + size[0], :3] = piece[: height - top, : width - left]


def _recoloured(own: Floats, wanted: Floats, brightest: NDArray[np.uint8]) -> Floats:
    """(256, 3) what each grey level of each channel becomes, so that its mean goes from ``own`` to ``wanted``.

    Darker by a factor. Lighter by a shift; where that would take the brightest value beyond white, the contrast falls
    until it is white. So the pattern is cut off at neither end.
    """
    levels = np.arange(256.0)[:, None]
    contrast = np.clip((255.0 - wanted) / np.maximum(brightest - own, 1e-9), 0.0, 1.0)
    return np.where(wanted < own, levels * (wanted / own), wanted + contrast * (levels - own))


def _mean(image: Frame) -> Floats:
    """(3,) over the pixels of an image (H, W, 3 or more)."""
    import cv2

    sums: Floats = np.asarray(cv2.sumElems(image), float)[:3]
    return sums / (image.shape[0] * image.shape[1])
