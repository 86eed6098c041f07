"""A context of MuJoCo 3.2.7 that switches from one model to the next and keeps the textures of both."""

import hashlib
from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls, check
from pipeline.rendering.plain_renderer import texels

SKINS = 64
"""Number of skins with texture coordinates, and of skins without; LIBERO's scenes have up to 50 large meshes."""

_TEXTURE = ' texcoord="0 0 0 0 0 0"'
_SKIN = (
    '<skin vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"{}>'
    '<bone body="bone" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin>'
)
_FIXED = (
    *("global_.offwidth", "global_.offheight", "global_.linewidth", "rgba.fog"),
    *("quality.offsamples", "quality.shadowsize", "quality.numslices", "quality.numstacks", "quality.numquads"),
)
"""Settings of ``mjVisual`` that a context keeps from its creation."""


def bare(model: mujoco.MjModel) -> mujoco.MjModel:
    """Create a model with only another model's planes and settings, and ``SKINS`` skins of both kinds."""
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    bare_model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{'<geom type="plane" size="1 1 1"/>' * len(planes)}<body name="bone"/></worldbody>
        <deformable>{_SKIN.format(_TEXTURE) * SKINS + _SKIN.format("") * SKINS}</deformable></mujoco>"""
    )
    bare_model.geom_size[:] = model.geom_size[planes]
    bare_model.stat.extent, bare_model.vis.map.zfar = model.stat.extent, model.vis.map.zfar
    for setting in _FIXED:
        part, name = setting.split(".")
        setattr(getattr(bare_model.vis, part), name, getattr(getattr(model.vis, part), name))
    return bare_model


def fixed(model: mujoco.MjModel) -> list[bytes]:
    """Return the bytes of a model's settings and planes, which a context cannot change for another model."""
    plane_sizes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    settings = [np.array(attrgetter(setting)(model.vis)).tobytes() for setting in _FIXED]
    return [*settings, plane_sizes.tobytes()]


def samples(count: int) -> NDArray[np.float32]:
    """Return the places (count, 2) of the samples in a pixel of the current context, 0 to 1 to the right and up."""
    opengl = calls()
    places = [opengl.glGetMultisamplefv(opengl.GL_SAMPLE_POSITION, sample) for sample in range(count)]
    return np.array(places, np.float32)


def adopt_size(context: mujoco.MjrContext, model: mujoco.MjModel) -> None:
    """Set the values that ``mjr_makeContext`` computes from a model's size."""
    context.shadowClip = model.stat.extent * model.vis.map.shadowclip
    context.shadowScale = model.vis.map.shadowscale
    context.fogStart = model.stat.extent * model.vis.map.fogstart
    context.fogEnd = model.stat.extent * model.vis.map.fogend


_SKY = -mujoco.mjtTextureRole.mjNTEXROLE + mujoco.mjtTextureRole.mjTEXROLE_RGB
"""Index of the sky's texture in ``mat_texid``: the last material of a context's fixed number of materials is the sky's.
"""


class Texture(NamedTuple):
    """Identity of a texture.

    Attributes:
        kind: type, height, width and number of channels.
        digest: hash of the texels.
    """

    kind: tuple[int, ...]
    digest: bytes


def textures_of(model: mujoco.MjModel) -> list[Texture]:
    """Return the identity of each texture of a model."""
    return [texture_of(model, number) for number in range(model.ntex)]


def texture_of(model: mujoco.MjModel, number: int) -> Texture:
    """Return the identity of a model's texture."""
    columns = (model.tex_type, model.tex_height, model.tex_width, model.tex_nchannel)
    return Texture(
        tuple(int(column[number]) for column in columns), hashlib.sha256(texels(model)[number].data).digest()
    )


def adopt_textures(
    context: mujoco.MjrContext, model: mujoco.MjModel, textures: Sequence[Texture], former: Sequence[Texture]
) -> None:
    """Replace a former model's textures in a context by a model's textures.

    Textures that both models have stay in the context: a scene has up to 190 MB of textures.

    Args:
        context: the context.
        model: the model.
        textures: the model's textures.
        former: the textures in the context.
    """
    unclaimed = dict(enumerate(context.texture[: len(former)].tolist()))
    new_textures = []
    for texture, identity in enumerate(textures):
        for number in unclaimed:
            if former[number] == identity:
                context.texture[texture] = unclaimed.pop(number)
                break
        else:
            context.texture[texture] = calls().glGenTextures(1)
            new_textures.append(texture)
    calls().glDeleteTextures([*unclaimed.values()])
    context.texture[model.ntex :] = 0
    context.ntexture, context.textureType[: model.ntex] = model.ntex, model.tex_type
    context.mat_texid[: model.mat_texid.size] = model.mat_texid.ravel()
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    context.mat_texid[_SKY] = skies[0] if len(skies) else -1
    context.mat_texrepeat[: model.mat_texrepeat.size] = model.mat_texrepeat.ravel()
    context.mat_texuniform[: model.nmat] = model.mat_texuniform
    for texture in new_textures:
        mujoco.mjr_uploadTexture(model, context, texture)
        check("mjr_uploadTexture")
