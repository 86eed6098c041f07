"""A context of MuJoCo 3.2.7 that goes on from one model to the next, with the textures that both have."""

from operator import attrgetter

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.drawing import texels
from pipeline.rendering.opengl import calls, check

SKINS = 64
"""As many with places in a texture, and as many without; LIBERO's scenes have up to 50 large meshes."""

_TEXTURE = ' texcoord="0 0 0 0 0 0"'
_SKIN = (
    '<skin vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"{}>'
    '<bone body="bone" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin>'
)
_FIXED = (
    *("global_.offwidth", "global_.offheight", "global_.linewidth", "rgba.fog"),
    *("quality.offsamples", "quality.shadowsize", "quality.numslices", "quality.numstacks", "quality.numquads"),
)
"""Settings of ``mjVisual`` that a context keeps as they were when it was made."""


def bare(model: mujoco.MjModel) -> mujoco.MjModel:
    """A model with nothing but another model's planes and settings, and ``SKINS`` skins of both kinds."""
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    made = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{'<geom type="plane" size="1 1 1"/>' * len(planes)}<body name="bone"/></worldbody>
        <deformable>{_SKIN.format(_TEXTURE) * SKINS + _SKIN.format("") * SKINS}</deformable></mujoco>"""
    )
    made.geom_size[:] = model.geom_size[planes]
    made.stat.extent, made.vis.map.zfar = model.stat.extent, model.vis.map.zfar
    for setting in _FIXED:
        part, name = setting.split(".")
        setattr(getattr(made.vis, part), name, getattr(getattr(model.vis, part), name))
    return made


def fixed(model: mujoco.MjModel) -> list[bytes]:
    """What a context cannot change for another model: its settings and planes."""
    planes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return [np.array(attrgetter(setting)(model.vis)).tobytes() for setting in _FIXED] + [planes.tobytes()]


def samples(count: int) -> NDArray[np.float32]:
    """(count, 2) where in a pixel of the current context its samples are, 0 to 1 to the right and up."""
    opengl = calls()
    places = [opengl.glGetMultisamplefv(opengl.GL_SAMPLE_POSITION, sample) for sample in range(count)]
    return np.array(places, np.float32)


def adopt_size(context: mujoco.MjrContext, model: mujoco.MjModel) -> None:
    """Set what ``mjr_makeContext`` computes from a model's size."""
    context.shadowClip = model.stat.extent * model.vis.map.shadowclip
    context.shadowScale = model.vis.map.shadowscale
    context.fogStart = model.stat.extent * model.vis.map.fogstart
    context.fogEnd = model.stat.extent * model.vis.map.fogend


_SKY = -mujoco.mjtTextureRole.mjNTEXROLE + mujoco.mjtTextureRole.mjTEXROLE_RGB
"""Where a context has the sky's texture: the last of all materials that it has room for is the sky's."""


def adopt_textures(context: mujoco.MjrContext, model: mujoco.MjModel, former: mujoco.MjModel) -> None:
    """Replace a former model's textures in a context by a model's. Those that both have stay: a scene has 140 MB."""
    kinds = [(m.tex_type, m.tex_height, m.tex_width, m.tex_nchannel) for m in (model, former)]
    there = texels(former)
    left = dict(enumerate(context.texture[: len(there)].tolist()))
    copied = []
    for texture, own in enumerate(texels(model)):
        for number in left:
            alike = all(mine[texture] == theirs[number] for mine, theirs in zip(*kinds, strict=True))
            if alike and np.array_equal(own, there[number]):
                context.texture[texture] = left.pop(number)
                break
        else:
            context.texture[texture] = calls().glGenTextures(1)
            copied.append(texture)
    calls().glDeleteTextures([*left.values()])
    context.texture[model.ntex :] = 0
    context.ntexture, context.textureType[: model.ntex] = model.ntex, model.tex_type
    context.mat_texid[: model.mat_texid.size] = model.mat_texid.ravel()
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    context.mat_texid[_SKY] = skies[0] if len(skies) else -1
    context.mat_texrepeat[: model.mat_texrepeat.size] = model.mat_texrepeat.ravel()
    context.mat_texuniform[: model.nmat] = model.mat_texuniform
    for texture in copied:
        mujoco.mjr_uploadTexture(model, context, texture)
        check("mjr_uploadTexture")
