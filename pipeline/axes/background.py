"""Background: materials of the room and the working surface. Render layer; both views change.

The new surface is resampled to the size of the scene's texture and written into it. Geometry, reflections and the
mapping onto a table or a wall stay LIBERO's. Half of the perturbations show the new surfaces in their own colours, as
LIBERO-Plus's tests do. In the other half the level decides: level 1 changes the pattern and keeps the average colour of
the replaced texture, level 5 shows the new texture's own average colour.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.axes.base import Axis, ByLevel, Credit, RenderPerturbation, Share, pick
from pipeline.axes.report_data import Bars, CoveragePlots, KeptPerturbation, ObservedEpisode
from pipeline.catalogue import textures
from pipeline.catalogue.data_maps import DATA_MAPS
from pipeline.catalogue.procedural import COLOUR_MAPS
from pipeline.catalogue.texture_sources import Source, Texture, keep
from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.arenas import Arena
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Frame, Frozen, Task

if TYPE_CHECKING:
    import mujoco

Component = Literal["theme", "surface"]
Part = Literal["wall", "floor", "cupboard", "surface"]

MATERIALS: dict[Part, dict[str, int]] = {
    "wall": {"walls_mat": 1},
    "floor": {"floorplane": 1},
    # Closes the kitchen's view, as the wall does in the other arenas.
    "cupboard": {"kitchen_background": 1},
    # Tabletop and kitchen, living room, study; without a table, the floor is the working surface.
    "surface": {"table_texture": 1, "living_room_table": 2, "desk": 4, "floorplane": 1},
}
"""Candidate materials of each part in LIBERO's five arenas (`scenes/*_base_style.xml`); the first shown one is used.

A new texture is repeated by the given number across the material's own texture. The top of a modelled table is only a
small piece of its unfolded skin."""

ABSENT_PARTS: dict[Arena, frozenset[Part]] = {
    "tabletop": frozenset({"cupboard"}),
    "kitchen": frozenset(),
    "living_room": frozenset({"cupboard"}),
    "study": frozenset({"cupboard"}),
    # A floor that is worked on is the surface.
    "floor": frozenset({"cupboard", "floor"}),
}
"""Parts that an arena does not show."""

PARTS: dict[Component, tuple[Part, ...]] = {"theme": ("wall", "floor", "cupboard", "surface"), "surface": ("surface",)}
"""Parts that a perturbation names a texture for. Every theme test of LIBERO-Plus names one for a wall and one for the
working surface."""

_DARKEST, _BRIGHTEST = 40.0, 205.0
"""Lowest and highest average grey level of a surface. Within them no light makes it a black or a white area."""

CHANGED_LEVELS = 8
"""Least difference of a channel, in grey levels, at which a pixel counts as changed."""


class Covering(Frozen):
    """Texture on one part of the scene.

    Attributes:
        part: covered part. Not every scene shows it (``BackgroundPerturbation.list_shown``).
        texture: name in the sources of :mod:`pipeline.catalogue.textures`.
        licence: licence that the texture's source states.
        sha256: hash of the texture.
        author: author of a user's texture, if the configuration names one.
        quarter_turns: number of counter-clockwise turns by 90 degrees.
    """

    part: Part
    texture: str
    licence: str
    sha256: str
    author: str = Field(default="", exclude_if=lambda author: not author)
    quarter_turns: Annotated[int, Field(ge=0, le=3)] = 0


class BackgroundPerturbation(RenderPerturbation):
    """New walls, floor and working surface, or a new working surface alone.

    Attributes:
        coverings: textures and the parts that they cover.
        colour_scale: position of the average colour between the replaced texture's (0) and the new texture's own (1).
    """

    axis: Literal["background"] = "background"
    component: Component
    coverings: tuple[Covering, ...]
    colour_scale: Share

    fields: ClassVar[tuple[str, ...]] = ("tex_data",)
    measure: ClassVar[str] = "0 if a test task shows an image of the same name or bytes, else 1"
    clearance: ClassVar[float] = 1.0

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the coverings into the model's textures.

        Raises:
            PipelineError: when a texture no longer exists, or the scene has none of the parts' materials.
        """
        # Two parts may share one texture: the last covering then counts for both.
        covered: dict[int, tuple[Covering, Skin]] = {}
        for covering in self.coverings:
            skin = skin_of(model, covering.part)
            if skin:
                covered[skin.texture] = (covering, skin)
        if not covered:
            materials: set[str] = set()
            materials.update(*MATERIALS.values())
            raise PipelineError(
                f"the scene shows no {' or '.join(c.part for c in self.coverings)}",
                where="model",
                expected=f"one of the materials {sorted(materials)}",
                remedy="use a scene of LIBERO's arenas",
            )
        for covering, skin in covered.values():
            image = np.rot90(textures.pixels(covering.texture, covering.sha256), covering.quarter_turns)
            _cover(model, skin, image, self.colour_scale)

    def distances(self, test: TestSet, task: Task) -> Floats:
        """Return one distance for all test tasks: 0 if any of them shows one of the images, on any part, else 1."""
        is_tested = any(_is_tested(covering, test) for covering in self.coverings)
        return np.full(len(test.on_axis("background")), 0.0 if is_tested else 1.0)

    def distances_to(self, others: Sequence[BackgroundPerturbation]) -> Floats:
        """Return 0 for perturbations that share an image with this one, 1 for the others (N,)."""
        images = self.images
        return np.array([float(images.isdisjoint(perturbation.images)) for perturbation in others])

    @property
    def images(self) -> set[str]:
        """Hashes of the textures."""
        return {covering.sha256 for covering in self.coverings}

    def list_shown(self, task: Task) -> tuple[Covering, ...]:
        """Return the coverings of the parts that the scene of a task has."""
        absent = ABSENT_PARTS[bddl.read(task.bddl_file).arena]
        return tuple(covering for covering in self.coverings if covering.part not in absent)

    def visible_part(self, task: Task) -> BackgroundPerturbation:
        """Return this change with the coverings that the scene of ``task`` shows."""
        return self.model_copy(update={"coverings": self.list_shown(task)})

    def credits(self, task: Task) -> frozenset[Credit]:
        """List the textures that the scene of ``task`` shows, with their licences."""
        return frozenset(Credit(c.texture, "texture", c.licence, c.author) for c in self.list_shown(task))

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the changed share of each view."""
        for view, changes in episode.changes().items():
            share = float((changes.max(axis=2) >= CHANGED_LEVELS).mean())
            yield f"share of {view} changed by {self.component}", share


class BackgroundAxis(Axis):
    """Components and texture sources to sample from.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), all five by default. Each entry has equal probability, except
            for perturbations in own colours, which have level 5.
        components: Components to sample, each entry with equal probability; both by default. ``theme`` covers walls,
            floor and working surface, ``surface`` only the working surface.
        sources: Sources of textures; by default the three that setup installs: ``libero``, ``robosuite`` and
            ``procedural``. pip downloads ``metaworld`` and ``gymnasium-robotics`` (63 MB) when a plan first uses them.
        own_colours: Share of perturbations that show all textures in their own colours, as all test tasks do; 0.5 by
            default. Such a perturbation has level 5, and occurs only if ``levels`` contains 5.
        map_share: Share of the perturbations in own colours with a data map on the working surface, if ``sources``
            contains ``procedural``; 0.7 by default, as in 751 of LIBERO-Plus's 1,076 background tests.
        image_share: Share of the other textures that are images instead of procedural colour maps; 0.3 by default.
        colour_scale: For each level, the share of the new texture's own average colour in the shown average colour.
            At 0 a texture has the average colour of the replaced one. Perturbations in own colours ignore the field. In
            each case the shown average is kept within 40 to 205 grey levels.
    """

    kinds: ClassVar = (BackgroundPerturbation,)
    colour: ClassVar = "#1f9e82"
    dimension: ClassVar = "background"
    test_scene: ClassVar = "scene files"

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = ("theme", "surface")
    sources: Annotated[tuple[Source, ...], Field(min_length=1)] = ("libero", "robosuite", "procedural")
    own_colours: Share = 0.5
    map_share: Share = 0.7
    image_share: Share = 0.3
    colour_scale: ByLevel[Share] = (0.2, 0.4, 0.6, 0.8, 1.0)

    def levels_set_shares(self, task: Task) -> bool:
        """Return whether no perturbation has level 5 for its textures' own colours."""
        return self.own_colours == 0 or 5 not in self.levels

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> BackgroundPerturbation:
        component = pick(rng, self.components)
        level = self.sample_level(rng)
        own_colours = rng.random() < self.own_colours and 5 in self.levels
        if own_colours:
            level = 5
        return BackgroundPerturbation(
            component=component,
            level=level,
            coverings=tuple(self._sample_covering(rng, part, own_colours) for part in PARTS[component]),
            colour_scale=1.0 if own_colours else self.colour_scale[level - 1],
        )

    def offered(self) -> dict[str, int]:
        """Count the distinct textures of ``sources``, and the procedural ones."""
        listed = _catalogue(self.sources).values()
        return {
            "surfaces": len({texture.sha256 for texture in listed}),
            "procedural": sum(texture.source == "procedural" for texture in listed),
        }

    def _sample_covering(self, rng: np.random.Generator, part: Part, own_colours: bool) -> Covering:
        """Sample the texture of a part.

        Args:
            own_colours: true if the perturbation shows its textures in their own colours.
        """
        colour_maps = _offered(self.sources, (*COLOUR_MAPS,))
        data_maps = _offered(self.sources, (*DATA_MAPS,))
        images = _offered(self.sources, (None,))
        if part == "surface" and own_colours and data_maps and rng.random() < self.map_share:
            texture = pick(rng, data_maps)
        elif images and (rng.random() < self.image_share or not colour_maps):
            texture = pick(rng, images)
        else:
            texture = pick(rng, colour_maps)
        keep(texture)
        return Covering(
            part=part,
            texture=texture.name,
            licence=texture.licence,
            sha256=texture.sha256,
            author=texture.author,
            quarter_turns=int(rng.integers(4)),
        )

    @classmethod
    def describe_coverage(
        cls, kept: Sequence[KeptPerturbation[BackgroundPerturbation]], test: TestSet
    ) -> CoveragePlots:
        """Describe a plot of the images by source and family."""
        names: list[str] = []
        for item in kept:
            names += [covering.texture for covering in item.perturbation.list_shown(item.task)]
        tested = test.on_axis("background")
        images = set()
        for task in tested:
            images |= {task.parameters[part] for part in ("surface", "wall") if part in task.parameters}
        # Examples of names: procedural:brick/028, metaworld:floor2.png.
        sources = Counter(name.rpartition("/" if "/" in name else ":")[0] for name in names)
        return CoveragePlots(
            f"{len(set(names))} distinct images in {len(kept)} perturbations. The {len(tested):,} test tasks show "
            f"{len(images)} images. A run stops if it has an image with the name or the content of one of these.",
            [Bars("Images by source and family", sources, "background", "uses")],
        )


@cache
def _offered(sources: tuple[Source, ...], families: tuple[str | None, ...]) -> list[Texture]:
    """List the textures of some families; images have the family ``None``."""
    return [texture for texture in _catalogue(sources).values() if texture.family in families]


@cache
def _catalogue(sources: tuple[Source, ...]) -> dict[str, Texture]:
    """Collect the textures of some sources, as ``textures.catalogue``.

    Raises:
        PipelineError: also when a user's image has the name of an image that test tasks show; it would never be
            sampled.
    """
    listed = textures.catalogue(sources)
    for texture in listed.values():
        if texture.own is not None and textures.normalise(texture.name) in _images_of(benchmark.load()):
            raise textures.unusable(texture, textures.TESTED_NAME)
    return listed


@cache
def _images_of(test: TestSet) -> frozenset[str]:
    """Return the normalised names of the images that test tasks show: LIBERO's walls, and the benchmark's surfaces."""
    names: set[str] = set()
    for tested in test.on_axis("background"):
        for part in ("surface", "wall"):
            file = tested.parameters.get(part)
            if isinstance(file, str):
                names.add(textures.normalise(file))
    return frozenset(names)


def _is_tested(covering: Covering, test: TestSet) -> bool:
    """Return whether a test task shows the covering's image, by its name or its bytes."""
    has_tested_name = textures.normalise(covering.texture) in _images_of(test)
    return has_tested_name or covering.sha256 in textures.test_images()


class Skin(NamedTuple):
    """Texture of a model and the number of times that a covering is repeated across it."""

    texture: int
    repeats: int


def skin_of(model: mujoco.MjModel, part: Part) -> Skin | None:
    """Return the texture that a part of the scene shows, or ``None`` if the scene has no such part."""
    for name, repeats in MATERIALS[part].items():
        try:
            material = model.material(name)
        except KeyError:
            continue
        # A material lists a texture for each of ten roles, or -1. LIBERO's materials have one texture, the colour.
        if material.texid.max() >= 0 and (model.geom_matid == material.id).any():
            return Skin(int(material.texid.max()), repeats)
    return None


def _cover(model: mujoco.MjModel, skin: Skin, image: Frame, colour_scale: float) -> None:
    """Write ``image`` (H, W, 3) over a texture of the model."""
    import cv2  # takes long, and every process of a run imports the axes

    height, width = int(model.tex_height[skin.texture]), int(model.tex_width[skin.texture])
    channels = int(model.tex_nchannel[skin.texture])
    start = int(model.tex_adr[skin.texture])
    texture = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    size = (width // skin.repeats, height // skin.repeats)
    interpolation = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
    piece = np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)
    own_mean, former_mean = _mean(piece).clip(1), _mean(texture)
    wanted_mean = former_mean + colour_scale * (own_mean - former_mean)
    wanted_mean *= np.clip(wanted_mean.mean(), _DARKEST, _BRIGHTEST) / wanted_mean.mean()
    changed = _recoloured(own_mean, wanted_mean, piece.max(axis=(0, 1)))
    table = np.rint(changed).clip(0, 255).astype(np.uint8)[None]
    piece = np.asarray(cv2.LUT(piece, table), np.uint8)
    for top, left in product(range(0, height, size[1]), range(0, width, size[0])):
        texture[top : top + size[1], left : left + size[0], :3] = piece[: height - top, : width - left]


def _recoloured(own: Floats, wanted: Floats, brightest: NDArray[np.uint8]) -> Floats:
    """Return the new value (256, 3) of each grey level and channel that changes the mean from ``own`` to ``wanted``.

    A factor darkens. A shift lightens; if it would take the brightest value beyond white, the contrast falls until
    this value is white. The pattern is therefore cut off at neither end.
    """
    levels = np.arange(256.0)[:, None]
    contrast = np.clip((255.0 - wanted) / np.maximum(brightest - own, 1e-9), 0.0, 1.0)
    return np.where(wanted < own, levels * (wanted / own), wanted + contrast * (levels - own))


def _mean(image: Frame) -> Floats:
    """Average the first three channels (3,) over the pixels of an image (H, W, 3 or more)."""
    import cv2

    sums: Floats = np.asarray(cv2.sumElems(image), float)[:3]
    return sums / (image.shape[0] * image.shape[1])
