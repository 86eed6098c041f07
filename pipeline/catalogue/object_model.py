"""Small MJCF models of objects: measured, turned upright and prepared for a scene."""

import copy
import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.errors import PipelineError
from pipeline.types import Floats

_UPRIGHT = {"z": np.array([1.0, 0.0, 0.0, 0.0]), "y": np.array([1.0, 1.0, 0.0, 0.0]) / np.sqrt(2.0)}
"""Rotations (w x y z) that bring a model's upward axis to the world's z."""
_DENSITY = 400.0
_MASS_KG = (0.05, 0.5)
# Contact parameters between LIBERO's objects and the table, plus friction against rolling: a ball comes to rest.
_CONTACT = {
    "priority": "1",
    "friction": "0.95 0.3 0.1",
    "solref": "0.001 1",
    "solimp": "0.998 0.998 0.001",
    "condim": "6",
}

_PLACES = {"axisangle", "xyaxes", "zaxis", "fromto"}
_TAGS = {"default", "include", "deformable", "frame", "replicate", "composite", "flexcomp", "attach"}
"""Elements that, like the attributes ``_PLACES``, place geoms in ways that this module does not read."""
_NOT_READ = {
    "compiler": {"strippath", "discardvisual"},
    "texture": {"fileright", "fileleft", "fileup", "filedown", "filefront", "fileback"},
    "geom": {"fitscale", "hfield"},
}
"""Element to attributes that change a model's files or appearance, and that this module does not read."""
_TYPES_NOT_READ = {"plane", "hfield", "sdf"}
_VIEWED = {"0", "1", "2"}
"""Groups of geoms that MuJoCo's viewer shows."""


class Shape(NamedTuple):
    """Measures of a model that stands upright.

    Attributes:
        low_m, high_m: (3,) bounds of its collision geometry in its own frame turned upright.
        volume_m3: volume of its collision geometry.
    """

    low_m: tuple[float, ...]
    high_m: tuple[float, ...]
    volume_m3: float

    @property
    def footprint_m2(self) -> float:
        """Area of the rectangle that the model stands on."""
        return (self.high_m[0] - self.low_m[0]) * (self.high_m[1] - self.low_m[1])


@dataclass(frozen=True)
class ObjectModel:
    """One object.

    Attributes:
        name: ``<source>/<name>``, unique.
        category: noun that an instruction would use, such as ``bottle_of_milk``.
        licence, attribution: texts for the dataset's card.
        mjcf: file of its model; the model's files are in the same folder or below.
        up: the axis of the model that points up when the model stands.
    """

    name: str
    category: str
    licence: str
    attribution: str
    mjcf: Path
    up: str = "z"

    @cached_property
    def sha256(self) -> str:
        """Hash of the model and of every file that it uses."""
        contents = [file.read_bytes() for file in (self.mjcf, *self.files)]
        return hashlib.sha256(b"".join(contents)).hexdigest()

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """Files of its meshes and textures."""
        return tuple(sorted({Path(asset.get("file", "")) for asset in self._assets if asset.get("file")}))

    @cached_property
    def shape(self) -> Shape:
        """Measures of the object, computed by compiling its collision geometry alone.

        Raises:
            PipelineError: when the model has no collision geometry, or MuJoCo cannot compile it.
        """
        import mujoco

        assets = "".join(ET.tostring(asset, "unicode") for asset in self._assets if asset.tag == "mesh")
        colliding = [geom for geom in self._geoms("", (0, 0, 0), 1.0) if not _is_visual(geom)]
        geoms = "".join(ET.tostring(geom, "unicode") for geom in colliding)
        try:
            model = mujoco.MjModel.from_xml_string(
                f'<mujoco><asset>{assets}</asset><worldbody><body name="object">{geoms}</body></worldbody></mujoco>'
            )
        except ValueError as error:
            raise PipelineError(
                f"MuJoCo cannot use the model ({error})",
                where=self.mjcf,
                expected="a model that mujoco.MjModel.from_xml_path compiles",
            ) from error
        if not model.ngeom:
            raise PipelineError(
                "the model has no collision geometry", where=self.mjcf, expected="a geom that can collide"
            )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        points = np.concatenate([_points(model, data, geom) for geom in range(model.ngeom)])
        volume = float(model.body("object").mass[0])
        return Shape(tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist()), volume)

    def mjcf_of(self, prefix: str) -> tuple[str, str]:
        """Return its assets and its body as MJCF; every name begins with ``prefix``, every path is absolute.

        The body ``prefix`` has a free joint. Its frame has z up and its origin in the middle of the underside.
        """
        low, high, volume = self.shape
        density = float(np.clip(_DENSITY * volume, *_MASS_KG)) / volume
        body = ET.Element("body", name=prefix)
        ET.SubElement(body, "joint", name=f"{prefix}_joint0", type="free", damping="0.0005")
        underside_to_origin_m = (-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2])
        body.extend(self._geoms(prefix, underside_to_origin_m, density))
        assets = "".join(ET.tostring(_renamed(asset, prefix), "unicode") for asset in self._assets)
        return assets, ET.tostring(body, "unicode")

    @cached_property
    def _root(self) -> ET.Element:
        """Root of the parsed MJCF.

        Raises:
            PipelineError: when the file is not readable, or has content that cannot be moved to another model.
        """
        try:
            root = ET.parse(self.mjcf).getroot()
        except (OSError, ET.ParseError) as error:
            raise PipelineError(
                f"the model is not readable ({error})", where=self.mjcf, expected="a MuJoCo model in XML"
            ) from error
        # Reject settings that would change the meaning of the geoms when they are moved to another model.
        folders = {"meshdir", "texturedir", "assetdir"}
        redirected = any(folders & set(compiler.attrib) for compiler in root.iter("compiler"))
        turned = any(element.get("euler", "0 0 0") != "0 0 0" for element in root.iter())
        bodies_and_geoms = [*root.iter("body"), *root.iter("geom")]
        placed = any(_PLACES & element.attrib.keys() for element in bodies_and_geoms)
        if redirected or turned or placed or any(element.tag in _TAGS for element in root.iter()):
            raise PipelineError(
                "the model uses defaults, includes, frames, asset folders or rotations other than quat",
                where=self.mjcf,
                expected="paths relative to the model, pos and quat for places, every attribute on its element",
                remedy="compile the model, save it with mujoco.mj_saveLastXML, then resolve frames and defaults",
            )
        for element in bodies_and_geoms:
            for name, count in (("pos", 3), ("quat", 4)):
                text = element.get(name)
                if text is not None and not _is_place(text, count):
                    raise PipelineError(
                        f'the model has <{element.tag} {name}="{text}">',
                        where=self.mjcf,
                        expected=f"{count} finite numbers" + (", not all zero" if name == "quat" else ""),
                    )
        unread = sorted(_unread(root))
        if unread:
            raise PipelineError(
                f"the model has {', '.join(unread)}, which would be left out",
                where=self.mjcf,
                expected="bodies of boxes, spheres, capsules, cylinders, ellipsoids and meshes; one file a texture",
                remedy="remove them from the model, or put the geoms into a body",
            )
        return root

    @cached_property
    def _assets(self) -> tuple[ET.Element, ...]:
        """Meshes, materials and textures that the geoms use, with absolute paths."""
        used: set[str | None] = set()
        for geom in self._root.iter("geom"):
            used |= {geom.get("mesh"), geom.get("material")}
        used.discard(None)
        for material in self._root.iter("material"):
            if material.get("name") in used:
                used.add(material.get("texture"))
                used.update(layer.get("texture") for layer in material.iter("layer"))
        assets = []
        for asset in self._root.findall("asset/*"):
            name = asset_name(asset)
            if name not in used:
                continue
            asset = copy.deepcopy(asset)
            asset.set("name", name)
            file = asset.get("file")
            if file:
                asset.set("file", str((self.mjcf.parent / file).resolve()))
            assets.append(asset)
        return tuple(assets)

    def _geoms(self, prefix: str, shift_m: Sequence[float], density: float) -> Iterator[ET.Element]:
        """Yield its geoms as geoms of one body that stands upright, moved by ``shift_m``.

        A geom that collides and is visible gives two geoms. Visual geoms have no mass.
        """
        placed = list(_placed(self._root.findall("worldbody/body"), np.array(shift_m, float), _UPRIGHT[self.up]))
        visible = _visible_geoms([geom for geom, _, _ in placed])
        for geom, pos, quat in placed:
            shape = {key: value for key, value in geom.attrib.items() if key in ("type", "mesh", "size")}
            shape |= {"pos": _numbers(pos), "quat": _numbers(quat)}
            if not _is_visual(geom):
                colliding = {**shape, **_CONTACT, "density": f"{density:.4f}", "group": "0", "rgba": "0 0 0 0"}
                yield _renamed(ET.Element("geom", colliding), prefix)
            if geom in visible:
                colours = {key: value for key, value in geom.attrib.items() if key in ("material", "rgba")}
                visual = {**shape, **colours, "contype": "0", "conaffinity": "0", "mass": "0", "group": "1"}
                yield _renamed(ET.Element("geom", visual), prefix)


def _placed(bodies: Iterable[ET.Element], pos: Floats, quat: Floats) -> Iterator[tuple[ET.Element, Floats, Floats]]:
    """Yield every geom of the bodies with its pose: position (3,) in m and quaternion (4,) w x y z.

    Joints are left out, so that everything stands as it is modelled.

    Args:
        bodies: elements whose geoms and child bodies are read.
        pos, quat: pose of the bodies' parent.
    """
    import mujoco

    for body in bodies:
        for child in body.findall("geom") + body.findall("body"):
            at, turn = pos, quat
            for element in (body, child) if child.tag == "geom" else (body,):
                moved, turned = np.zeros(3), np.zeros(4)
                mujoco.mju_rotVecQuat(moved, np.array(element.get("pos", "0 0 0").split(), float), turn)
                mujoco.mju_mulQuat(turned, turn, np.array(element.get("quat", "1 0 0 0").split(), float))
                at, turn = at + moved, turned / np.linalg.norm(turned)
            if child.tag == "geom":
                yield child, at, turn
            else:
                yield from _placed([child], at, turn)


def _is_place(text: str, count: int) -> bool:
    """Return whether a text has ``count`` finite numbers, not all of them zero if they are a quaternion's four."""
    try:
        numbers = np.array(text.split(), float)
    except ValueError:
        return False
    return len(numbers) == count and bool(np.isfinite(numbers).all()) and (count != 4 or bool(numbers.any()))


def _numbers(values: Floats) -> str:
    return " ".join(f"{value:.7g}" for value in values)


def asset_name(asset: ET.Element) -> str:
    """Return the name that geoms and materials use for an asset: its own, or else that of its file, as in MuJoCo."""
    return asset.get("name") or Path(asset.get("file", "")).stem


def _unread(root: ET.Element) -> Iterator[str]:
    """Yield the parts of a model that would be left out without a trace."""
    for tag, attributes in _NOT_READ.items():
        for element in root.iter(tag):
            for name in attributes & element.attrib.keys():
                yield f"<{tag} {name}>"
    for geom in root.iter("geom"):
        if geom.get("type") in _TYPES_NOT_READ:
            yield f"<geom type={geom.get('type')}>"
    if root.find("worldbody/geom") is not None:
        yield "<geom> outside of a body"
    if root.find("asset/skin") is not None or root.find("deformable") is not None:
        yield "<skin>"


def _is_visual(geom: ET.Element) -> bool:
    return geom.get("contype") == "0" and geom.get("conaffinity") == "0"


def _visible_geoms(geoms: Sequence[ET.Element]) -> list[ET.Element]:
    """Return the visible geoms: the geoms that MuJoCo's viewer shows.

    If the model has visual geoms, its colliding geoms with an explicit group 0 are not visible: robosuite, and
    therefore LIBERO, keeps collision geometry in group 0 and renders group 1. If no geom would be visible, all are.
    """
    has_visual = any(_is_visual(geom) for geom in geoms)
    viewed = [geom for geom in geoms if geom.get("group", "0") in _VIEWED]
    if has_visual:
        viewed = [geom for geom in viewed if _is_visual(geom) or geom.get("group") != "0"]
    return viewed or list(geoms)


def _renamed(element: ET.Element, prefix: str) -> ET.Element:
    """Copy an element and its children, and put ``prefix`` before every name."""
    renamed = copy.deepcopy(element)
    renamed.tail = None
    for part in renamed.iter():
        for key in ("name", "mesh", "material", "texture"):
            if prefix and key in part.attrib:
                part.set(key, f"{prefix}_{part.attrib[key]}")
    return renamed


def _points(model: Any, data: Any, geom: int) -> Any:
    """Return world points (N, 3) with the bounds of a geom: a mesh's vertices, else the corners of the geom's box."""
    mesh = model.geom_dataid[geom]
    if mesh >= 0:
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        local = model.mesh_vert[start : start + count]
    else:
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        local = centre + half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
