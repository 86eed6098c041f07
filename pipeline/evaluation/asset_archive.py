"""Scenes, images and models that test tasks of light, background and layout need, and where they are.

62 background tasks need LIBERO's own assets alone. The others need LIBERO-Plus's asset archive (``assets.zip``, 6.4 GB,
in the dataset Sylvest/LIBERO-plus on the hub), which takes the place of LIBERO's assets in the benchmark. Which files a
task needs is in the benchmark's code, which is read as text.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.files import Edition, checksum_of, edition
from pipeline.libero.assets import libero_assets
from pipeline.physics.control_env import control_env
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask
from pipeline.testset.definitions import Reader, SceneFiles

_ROTATION_RAD = {"x": (-np.pi / 2, -np.pi / 2), "y": (-np.pi, -np.pi), "z": (np.pi, np.pi)}
"""How LIBERO's reset turns an added object: the same for all 867 models of the benchmark."""


def having(test: TestTask, archive: Path | None) -> Path | None:
    """LIBERO's assets or the archive, whichever has the files of a light, background or layout task; None if neither.

    Args:
        archive: folder of the unpacked archive, where there is one.
    """
    for folder in (libero_assets(), archive):
        if folder is not None and all((unpacked(folder) / path).is_file() for path in _named(test)):
            return unpacked(folder)
    return None


@cache
def unpacked(folder: Path) -> Path:
    """The folder with ``scenes``, ``textures`` and ``new_objects``.

    The archive has its files below the path that they had on the machine that packed it, so ``folder`` may be any on
    the way to them.

    Raises:
        PipelineError: when there is none.
    """
    root = folder
    while not (root / "scenes").is_dir():
        below = [path for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
        if len(below) != 1:
            raise PipelineError(
                "not the unpacked asset archive of LIBERO-Plus",
                where=root,
                expected="a folder with scenes, textures and new_objects, or one that leads to it",
                remedy="unpack assets.zip of the dataset Sylvest/LIBERO-plus, and name that folder",
            )
        (root,) = below
    return root.resolve()


def scene(test: TestTask, assets: Path) -> SceneFiles:
    """The files of a light or background task; absolute paths."""
    return SceneFiles(*(str(assets / path) for path in scene_files(test)))


def register_objects(test: TestTask, assets: Path) -> None:
    """Let LIBERO build scenes with the objects that a layout task adds, by the categories of its BDDL file."""
    control_env()  # which takes care of how it is imported
    from libero.libero.envs.base_object import OBJECTS_DICT

    for category, path in object_models(test).items():
        OBJECTS_DICT[category] = _object_class(category, assets / path)


def contents(test: TestTask, archive: Path | None) -> list[str]:
    """SHA-256 of each file of LIBERO's assets or the archive that a light, background or layout task is made from:
    those that it names, then those that they refer to. Empty for tasks of other axes."""
    assets = having(test, archive) if test.axis in ("light", "background", "layout") else None
    if assets is None:
        return []
    files = [assets / path for path in _named(test)]
    for file in files:
        if file.suffix == ".xml":
            read = (file.parent / path for path in _referred(edition(file)))
            files += [path.resolve() for path in read if path.is_file() and path.resolve() not in files]
    return [checksum_of(edition(file)) for file in files]


def _named(test: TestTask) -> Iterable[str]:
    """The files that a light, background or layout task names."""
    return object_models(test).values() if test.axis == "layout" else scene_files(test)


@cache
def _referred(file: Edition) -> tuple[str, ...]:
    try:
        return tuple(element.attrib["file"] for element in ET.parse(file.path).iterfind(".//*[@file]"))
    except ET.ParseError as error:
        raise PipelineError(f"not XML ({error})", where=file.path, remedy="unpack the archive again") from error


def scene_files(test: TestTask) -> SceneFiles:
    """Of a light or background task, by their paths in the archive."""
    return _reader().scene_files(test.suite, test.name)


def object_models(test: TestTask) -> dict[str, str]:
    """Category to MJCF, by its path in the archive, of the objects that a layout task adds."""
    return {category: _models()[category] for category in str(test.parameters["category"]).split(",")}


@cache
def _reader() -> Reader:
    return Reader(zipfile.ZipFile(benchmark.fetch_testset()))


@cache
def _models() -> dict[str, str]:
    return _reader().object_models()


def _object_class(category: str, file: Path) -> Any:
    """What LIBERO makes each object of a category with."""
    from robosuite.models.objects import MujocoXMLObject

    class AddedObject(MujocoXMLObject):  # type: ignore[misc]
        """A model of the archive as the benchmark's code loads it."""

        def __init__(self, name: str = category):
            joints = [{"type": "free", "damping": "0.0005"}]
            super().__init__(str(file), name=name, joints=joints, obj_type="all", duplicate_collision_geoms=False)
            self.category_name = category
            self.object_properties: dict[str, Any] = {"vis_site_names": {}}
            self.rotation, self.rotation_axis = _ROTATION_RAD, None

        def _get_object_subtree(self) -> Any:
            """The body ``object``; robosuite expects it in another body, these models may have it at the top."""
            if self.worldbody.find("./body/body[@name='object']") is not None:
                return super()._get_object_subtree()
            body = self.worldbody.find("./body[@name='object']")
            if body is None:
                raise PipelineError("the model has no body 'object'", where=file)
            holder = ET.SubElement(self.worldbody, "body")
            holder.append(body)
            try:
                return super()._get_object_subtree()
            finally:
                self.worldbody.remove(holder)

    return AddedObject
