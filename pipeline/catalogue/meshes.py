"""Conversion of a Wavefront OBJ with its materials to a MuJoCo model of one object.

The model has visual meshes, and a convex hull for contacts. trimesh is imported by the functions that use it: its
import takes seconds, and every process of a run imports this module, but hardly any process converts a mesh.
"""

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import PipelineError
from pipeline.types import Floats

RECIPE = 1
"""Number to raise whenever a change here changes the converted models: earlier models are then converted again."""

FACES = 6000
"""Largest number of faces of a model; LIBERO's own models have up to 20,000."""
_SMALL_PART = 300
_HULL_VERTICES = 48
_THINNEST_M = 1e-3
_TEXTURE_PX = 512
_SHEET_M = 5e-4
_OPAQUE = 0.25
"""Least opacity: glass that is more transparent can hardly be seen in a frame of 256 x 256."""


class _Surface(NamedTuple):
    """A mesh.

    Attributes:
        vertices: (V, 3) metres, z up.
        faces: (F, 3) indices.
        uv: (V, 2) texture coordinates, if the mesh has a texture.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    uv: Floats | None


class _Part(NamedTuple):
    """The faces of one material; if the material has an image, the surface has ``uv``."""

    surface: _Surface
    rgba: Floats
    image: Image.Image | None


def material_files(obj: Path) -> list[Path]:
    """List the files of an OBJ's materials: its material library and the images that the library names.

    trimesh converts a model without the materials and images that it cannot read. Therefore they are checked here.

    Raises:
        PipelineError: when the OBJ or the library cannot be read, or an image is missing or damaged.
    """
    libraries = [obj.parent / name for name in _values(obj, "mtllib")[:1]]  # trimesh reads the first one
    images: list[Path] = []
    for library in libraries:
        images += [obj.parent / name for name in _values(library, "map_kd")]
    for image in images:
        try:
            with Image.open(image) as opened:
                opened.load()
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise _unreadable(image, error) from error
    return libraries + images


def _values(file: Path, key: str) -> list[str]:
    """Return the rest of each line of a text file that begins with a key."""
    try:
        lines = file.read_text(errors="replace").splitlines()
    except OSError as error:
        raise _unreadable(file, error) from error
    values: list[str] = []
    for line in lines:
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].lower() == key:
            values.append(words[1].rstrip())
    return values


def _unreadable(file: Path, error: Exception) -> PipelineError:
    """Return the error about a file that an OBJ or its library names."""
    return PipelineError(
        f"the model's file cannot be read ({error})",
        where=file,
        expected="the name of a readable file after mtllib or map_Kd, without options",
        remedy="put the file there, replace a damaged file, or correct the name in the line",
    )


def convert(obj: Path, out: Path, size_m: tuple[float, float, float] | None = None, turn: Floats | None = None) -> None:
    """Write ``model.xml``, meshes and textures of an OBJ (y up) into the folder ``out``.

    The model stands on the origin with z up. Its collision geometry is one convex hull: this is enough for objects
    that the robot only has to avoid, and a hull is equal on every machine.

    Args:
        obj: the model; its materials and textures are in the same folder.
        out: an existing folder.
        size_m: extent along x, depth and height that the model is scaled to; without it, the model keeps its size in
            metres.
        turn: (3, 3) rotation of the model before it is scaled.

    Raises:
        PipelineError: when the file is not a readable OBJ, or the model is too flat or broken for a hull.
    """
    import trimesh

    try:
        parts = _parts(obj, size_m, np.eye(3) if turn is None else turn)
        points = np.concatenate([part.surface.vertices for part in parts])
        if np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] < _THINNEST_M:
            raise ValueError("it is flat")
        hull = trimesh.convex.convex_hull(points)
    except (ValueError, IndexError, KeyError, OSError, RuntimeError) as error:
        raise PipelineError(
            f"the model cannot be converted to an object ({error})", where=obj, expected="a closed OBJ"
        ) from error
    assets, geoms = [], []
    for number, part in enumerate(parts):
        name = f"part{number}"
        _write_obj(out / f"{name}.obj", part.surface)
        colour = quoteattr(" ".join(f"{value:.4g}" for value in part.rgba))
        texture = ""
        if part.image is not None:
            small = part.image.convert("RGB")
            small.thumbnail((_TEXTURE_PX, _TEXTURE_PX))
            small.save(out / f"{name}.png")
            assets.append(f'<texture name="{name}" type="2d" file="{name}.png"/>')
            texture = f' texture="{name}"'
        assets.append(f'<material name="{name}"{texture} rgba={colour} specular="0.3" shininess="0.3"/>')
        assets.append(f'<mesh name="{name}" file="{name}.obj"/>')
        geoms.append(
            f'<geom type="mesh" mesh="{name}" material="{name}" group="1" contype="0" conaffinity="0" mass="0"/>'
        )
    _write_obj(out / "hull.obj", _Surface(np.asarray(hull.vertices), np.asarray(hull.faces), None))
    assets.append(f'<mesh name="hull" file="hull.obj" maxhullvert="{_HULL_VERTICES}"/>')
    geoms.append('<geom type="mesh" mesh="hull" group="0"/>')
    lines = "\n    ".join
    (out / "model.xml").write_text(
        f'<mujoco model="object">\n  <asset>\n    {lines(assets)}\n  </asset>\n'
        f'  <worldbody>\n    <body name="object">\n    {lines(geoms)}\n    </body>\n  </worldbody>\n</mujoco>\n'
    )


def _parts(obj: Path, size_m: tuple[float, float, float] | None, turn: Floats) -> list[_Part]:
    """Load an OBJ as parts of one material each: turned, scaled, z up, with the origin in the middle of the underside.

    Args:
        obj, size_m, turn: see ``convert``.
    """
    import trimesh

    scene = trimesh.load_scene(obj, process=False)
    meshes = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    vertices = np.concatenate([mesh.vertices @ turn.T for mesh in meshes])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = np.ones(3)
    if size_m is not None:
        width, depth, height = size_m
        scale = np.array([width, height, depth]) / np.maximum(high - low, 1e-9)
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stand = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    share = min(1.0, FACES / sum(len(mesh.faces) for mesh in meshes))
    parts = []
    for mesh in meshes:
        material = getattr(mesh.visual, "material", None)
        coordinates = getattr(mesh.visual, "uv", None)
        image = None if coordinates is None else getattr(material, "image", None)
        uv = None if image is None else np.asarray(coordinates)
        surface = _Surface((mesh.vertices @ turn.T - foot) * scale @ stand.T, np.asarray(mesh.faces), uv)
        if share < 1.0:
            surface = _simplified(surface, share)
        rgba = np.array([0.7, 0.7, 0.7, 1.0] if material is None else material.main_color / 255.0)
        if image is not None:
            rgba[:3] = 1.0
        rgba[3] = max(rgba[3], _OPAQUE)
        if len(surface.faces):
            parts.append(_Part(_thickened(surface), rgba, image))
    return parts


def _simplified(surface: _Surface, share: float) -> _Surface:
    """Reduce the faces of a surface to about ``share`` of their number.

    Small parts keep their faces. Textured parts keep them too, because collapsing edges would distort the texture.
    """
    if surface.uv is not None or len(surface.faces) < _SMALL_PART:
        return surface
    import fast_simplification
    import trimesh

    # Some faces share positions but not vertices, because each has its own normals. Unmerged, they would come apart.
    merged = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    merged.merge_vertices(merge_norm=True, merge_tex=True)
    vertices, faces = fast_simplification.simplify(
        np.asarray(merged.vertices, np.float32), np.asarray(merged.faces, np.int32), target_reduction=1.0 - share
    )
    return _Surface(vertices.astype(np.float64), faces.astype(np.int64), None)


def _thickened(surface: _Surface) -> _Surface:
    """Give a flat part a back, because MuJoCo finds no frame for a mesh without volume."""
    vertices, faces, uv = surface
    used = vertices[np.unique(faces)]
    _, extents, axes = np.linalg.svd(used - used.mean(axis=0), full_matrices=False)
    if len(used) > 3 and extents[2] > 1e-3 * extents[1]:
        return surface
    normal = np.cross(*(vertices[faces[0, 1:]] - vertices[faces[0, 0]]))
    length = np.linalg.norm(normal)
    normal = axes[2] if len(axes) > 2 and length < 1e-12 else normal / max(length, 1e-12)
    both = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    back = vertices - _SHEET_M * normal
    return _Surface(np.concatenate([vertices, back]), both, None if uv is None else np.tile(uv, (2, 1)))


def _write_obj(path: Path, surface: _Surface) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in surface.vertices]
    corner = "{0}" if surface.uv is None else "{0}/{0}"
    if surface.uv is not None:
        lines += [f"vt {u:.5f} {v:.5f}" for u, v in surface.uv]
    for face in surface.faces:
        corners = " ".join(corner.format(index + 1) for index in face)
        lines.append(f"f {corners}")
    path.write_text("\n".join(lines) + "\n")
