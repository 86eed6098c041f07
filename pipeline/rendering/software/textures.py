"""The textures of a model in an OpenGL context of MuJoCo, some of them changed for a while."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation
from pipeline.rendering.opengl import calls, check
from pipeline.scenes.compiled import Images


class Textures:
    """By their numbers in the model; MuJoCo's OpenGL context must be the current one.

    Args:
        model: whose textures they are.
        context: made from the model, or from another one.
        former: those of the model whose textures the context has, where it is another one. What both have stays there
            and is not copied again: a scene has 140 MB of textures, which take a second.
        images: of a model that was compiled without them; else it has its own.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        context: mujoco.MjrContext,
        former: Textures | None = None,
        images: Images | None = None,
    ):
        self._model, self._context, self._images = model, context, images
        self._names = [model.tex(texture).name for texture in range(model.ntex)]
        self._contents = [images.content(name) if images else None for name in self._names]
        self._kept: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._own = context.texture.copy()
        if former is None:
            self._load([texture for texture, content in enumerate(self._contents) if content])
        else:
            self._replace(former)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The model with its images: what perturbations that paint write into. Compiled where it has none itself."""
        return self._images.scene() if self._images else self._model

    def _replace(self, former: Textures) -> None:
        left, model, context = former._own[: former._model.ntex].tolist(), self._model, self._context
        self._own[:], copied = 0, []
        for texture in range(model.ntex):
            same = (number for number in range(len(left)) if left[number] and self._same(texture, former, number))
            if (number := next(same, None)) is None:
                self._own[texture] = calls().glGenTextures(1)
                copied.append(texture)
            else:
                self._own[texture], left[number] = left[number], 0
        # OpenGL passes over the zeros.
        calls().glDeleteTextures(left)
        context.ntexture, context.textureType[: model.ntex] = model.ntex, model.tex_type
        context.mat_texid[: model.mat_texid.size] = model.mat_texid.ravel()
        context.mat_texrepeat[: model.mat_texrepeat.size] = model.mat_texrepeat.ravel()
        context.mat_texuniform[: model.nmat] = model.mat_texuniform
        self.show({})
        for texture in copied:
            if not self._contents[texture]:
                self._copy(model, texture)
        self._load([texture for texture in copied if self._contents[texture]])

    def _load(self, textures: Sequence[int]) -> None:
        """Read images and copy them to the context."""
        if not textures or self._images is None:
            return
        loaded = self._images.load([self._names[texture] for texture in textures])
        try:
            self._context.texture[: len(textures)] = self._own[[*textures]]
            for number in range(len(textures)):
                self._copy(loaded, number)
        finally:
            self.show({})

    def _same(self, texture: int, other: Textures, number: int) -> bool:
        """Whether a texture is the one that another model has under a number."""
        if self._contents[texture] or other._contents[number]:
            return self._contents[texture] == other._contents[number]
        fields = [(m.tex_type, m.tex_height, m.tex_width, m.tex_nchannel) for m in (self._model, other._model)]
        if any(own[texture] != theirs[number] for own, theirs in zip(*fields, strict=True)):
            return False
        own, theirs = _texels(self._model)[texture], _texels(other._model)[number]
        return np.array_equal(self._model.tex_data[own], other._model.tex_data[theirs])

    def keep(self) -> None:
        """Have a copy of the model's textures, before they are written."""
        # A hundred megabytes and more: made once, for those to whom it matters.
        if len(self._kept) != len(self.model.tex_data):
            self._kept = self.model.tex_data.copy()

    def former(self) -> dict[int, NDArray[np.uint8]]:
        """The former bytes of the textures that were written since ``keep`` was called first, or this was."""
        there, former = self.model.tex_data, {}
        for texture, texels in enumerate(_texels(self.model)):
            if not np.array_equal(self._kept[texels], there[texels]):
                former[texture] = self._kept[texels].copy()
                self._kept[texels] = there[texels]
        return former

    def put_back(self, former: Mapping[int, NDArray[np.uint8]]) -> None:
        """Write former bytes of textures into the model."""
        for texture, value in former.items():
            texels = _texels(self.model)[texture]
            self.model.tex_data[texels] = self._kept[texels] = value

    def upload(self, textures: Iterable[int]) -> None:
        """Copy textures of the model with its images to the context."""
        for texture in textures:
            self._copy(self.model, texture)

    def _copy(self, model: mujoco.MjModel, texture: int) -> None:
        mujoco.mjr_uploadTexture(model, self._context, texture)
        check("mjr_uploadTexture")

    @contextmanager
    def held(self, choices: Sequence[Sequence[RenderPerturbation]]) -> Iterator[list[dict[int, int]]]:
        """Have the context hold what each choice of perturbations makes of the model's textures.

        Returns:
            For each choice, the textures that it changes and OpenGL's names of what they are changed to.
        """
        held: list[dict[int, int]] = []
        try:
            for perturbations in choices:
                held.append(self._changed(perturbations))
            yield held
        finally:
            self.show({})
            calls().glDeleteTextures([name for names in held for name in names.values()])

    def _changed(self, perturbations: Sequence[RenderPerturbation]) -> dict[int, int]:
        if not perturbations:
            return {}
        names: dict[int, int] = {}
        former: dict[int, NDArray[np.uint8]] = {}
        self.keep()
        try:
            try:
                for perturbation in perturbations:
                    perturbation.apply(self.model)
            finally:
                former = self.former()
            opengl = calls()
            for texture in former:
                names[texture] = int(opengl.glGenTextures(1))
            self.show(names)
            self.upload(names)
        finally:
            self.put_back(former)
            self.show({})
        return names

    def show(self, names: Mapping[int, int]) -> None:
        """Have textures drawn with what OpenGL holds under other names, and all others with what is their own."""
        self._context.texture[:] = self._own
        self._context.texture[[*names]] = [*names.values()]

    def geoms_with(self, textures: Collection[int]) -> NDArray[np.bool_]:
        """(ngeom,) which geoms have one of the textures."""
        of_material = np.isin(self._model.mat_texid, [*textures]).reshape(self._model.nmat, -1).any(axis=1)
        return np.asarray(np.append(of_material, False)[self._model.geom_matid])


def _texels(model: mujoco.MjModel) -> list[slice]:
    """Where each texture's bytes lie in a model's ``tex_data``."""
    sizes = model.tex_height * model.tex_width * model.tex_nchannel
    return [slice(start, start + size) for start, size in zip(model.tex_adr.tolist(), sizes.tolist(), strict=True)]
