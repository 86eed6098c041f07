"""LIBERO-Plus's test tasks rebuilt from their parameters, as its own code sets them up.

Tasks that change the camera, the robot, the noise, the instruction or where things stand need LIBERO's assets alone,
and so do 62 of background. The others of background, light and layout (confounding objects) need scenes, images and
models of LIBERO-Plus's asset archive (``assets.zip``, 6.4 GB, in the dataset Sylvest/LIBERO-plus on the hub), which
takes the place of LIBERO's assets in the benchmark. Which files a task needs is read from its code, as text.
"""

import io
import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from pipeline import seeding
from pipeline.axes import level_of_test
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.noise import NoisePerturbation, effect_of
from pipeline.errors import PipelineError
from pipeline.evaluation.tasks import Prompt
from pipeline.files import Edition, checksum_of, edition
from pipeline.libero.assets import libero_assets
from pipeline.libero.tasks import find_task
from pipeline.physics.control_env import control_env
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask
from pipeline.testset.definitions import Reader, SceneFiles
from pipeline.types import Floats

RUNNABLE = ("camera", "robot", "noise", "language", "pose")
"""The axes whose test tasks can all be rebuilt without the benchmark's asset archive: 6,983 tasks."""

DECIMALS = 4
"""To which the benchmark rounds its camera after each turn."""

ROTATION_RAD = {"x": (-np.pi / 2, -np.pi / 2), "y": (-np.pi, -np.pi), "z": (np.pi, np.pi)}
"""How LIBERO's reset turns an added object: the same for all 867 models of the benchmark."""


class TestCamera(CameraPerturbation):
    """The agent view of a test task: rounded after each turn, also where nothing turns it.

    So the camera of a task that changes something else is off LIBERO's own by up to 5e-5 (m, and in the quaternion).
    """

    __test__: ClassVar[bool] = False

    def apply(self, model: mujoco.MjModel) -> None:
        """Move the model's agent view; nothing else in the model changes."""
        camera = model.camera("agentview")
        pos_m, quat_wxyz = camera.pos.copy(), camera.quat.copy()
        # In the benchmark's order; each step leaves the other parameters neutral.
        for changed in self._steps():
            placed = changed.pose(pos_m, quat_wxyz / np.linalg.norm(quat_wxyz))
            pos_m, quat_wxyz = (np.array([round(float(number), DECIMALS) for number in part]) for part in placed)
        # SciPy's ``Rotation``, with which the benchmark turns, makes it a unit quaternion.
        camera.pos[:], camera.quat[:] = pos_m, quat_wxyz / np.linalg.norm(quat_wxyz)

    def _steps(self) -> list[CameraPerturbation]:
        # Angles from 0 to 360, as the benchmark's names have them: a half is rounded another way after 330 than after
        # -30. The last two turn the orientation alone, about the world's axes, as ``pose`` does.
        steps = {
            "elevation_deg": self.elevation_deg,
            "azimuth_deg": self.azimuth_deg % 360,
            "distance_scale": self.distance_scale,
            "yaw_deg": self.yaw_deg % 360,
            "pitch_deg": self.pitch_deg % 360,
        }
        # But for the azimuth, nothing is rounded that is not changed.
        neutral = {"elevation_deg": 0, "distance_scale": 1, "yaw_deg": 0, "pitch_deg": 0}
        return [
            CameraPerturbation.model_validate({"component": self.component, "level": self.level, name: value})
            for name, value in steps.items()
            if value != neutral.get(name)
        ]


def camera(test: TestTask) -> TestCamera:
    """The agent view of a test task, whatever its axis."""
    if test.axis != "camera":
        return TestCamera(component="orientation", level=1)
    return TestCamera.model_validate({"component": test.component, "level": level_of_test(test), **test.parameters})


def noise(test: TestTask, seed: int) -> NoisePerturbation:
    """The corruption of a noise task.

    Args:
        seed: of what is drawn anew for every frame: the direction of motion, fog and glass. The benchmark draws it from
            a global generator.
    """
    own = int(seeding.rng("evaluation", seed, "noise", test.suite, test.name).integers(2**53))
    what = {"component": test.component, "effect": effect_of(test), "level": level_of_test(test), "seed": own}
    return NoisePerturbation.model_validate(what)


@cache
def postures_rad() -> dict[int, tuple[float, ...]]:
    """Number of a robot task's start to the (7,) joint angles in its class's table, with all of their digits."""
    source = _reader().packed("envs/robots/mounted_panda.py").decode()
    listed = re.findall(r"class MountedPanda(\d+)\(.*?np\.array\(\[([^\]]+)\]\)", source, flags=re.DOTALL)
    return {int(number): tuple(map(float, row.split(","))) for number, row in listed}


def bddl_text(test: TestTask) -> str:
    """The file that defines the scene of a pose or layout task."""
    return _reader().packed(f"bddl_files/{test.suite}/{test.name}.bddl").decode()


def moved_state(suite: str, name: str) -> Floats:
    """(S,) the one state of a task that moves objects."""
    return saved_array(_reader().packed(f"init_files/libero_newobj/{suite}/{name}.pruned_init")).reshape(-1)


def saved_array(content: bytes) -> Floats:
    """The array that ``torch.save`` wrote as a pickle, by PyTorch's own reader, which runs none.

    Raises:
        UnpicklingError: when the pickle names anything but what makes an array of numbers.
    """
    import torch  # which takes seconds, and few tasks need

    reconstruct: Any = np.empty(0).__reduce__()[0]
    named = (reconstruct, "numpy.core.multiarray._reconstruct")
    with torch.serialization.safe_globals([named, np.ndarray, np.dtype, np.dtypes.Float64DType]):
        return np.asarray(torch.load(io.BytesIO(content), weights_only=True), np.float64)


def instruction(test: TestTask, prompt: Prompt) -> str:
    """What a policy is told in a test task; a language task is worded as it says, unless nothing is said."""
    if prompt == "blank":
        return ""
    if test.axis == "language":
        return str(test.parameters["text"])
    if prompt == "clean":
        return find_task(test.suite, test.base).instruction
    # Such as KITCHEN_SCENE3_turn_on_the_stove.
    return re.sub(r"^[A-Z].*?SCENE\d+_", "", test.name).replace("_", " ")


def assets_of(test: TestTask, archive: Path | None = None) -> Path | None:
    """LIBERO's assets or the archive, whichever has the files that a test task names; None if neither, where it cannot
    be rebuilt.

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


def register_objects(test: TestTask, assets: Path) -> None:
    """Let LIBERO build scenes with the objects that a layout task adds, by the categories of its BDDL file."""
    control_env()  # which takes care of how it is imported
    from libero.libero.envs.base_object import OBJECTS_DICT

    for category, path in object_models(test).items():
        OBJECTS_DICT[category] = _object_class(category, assets / path)


def contents(test: TestTask, archive: Path | None) -> list[str]:
    """SHA-256 of each file of LIBERO's assets or the archive that a test task is made from: those that it names, then
    those that they refer to."""
    assets = assets_of(test, archive)
    files = [] if assets is None else [assets / path for path in _named(test)]
    for file in files:
        if file.suffix == ".xml":
            read = (file.parent / path for path in _referred(edition(file)))
            files += [path.resolve() for path in read if path.is_file() and path.resolve() not in files]
    return [checksum_of(edition(file)) for file in files]


def _named(test: TestTask) -> Iterable[str]:
    if test.axis == "layout":
        return object_models(test).values()
    return scene_files(test) if test.axis in ("light", "background") else ()


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
    models = _reader().object_models
    return {category: models[category] for category in str(test.parameters["category"]).split(",")}


@cache
def _reader() -> Reader:
    return Reader(zipfile.ZipFile(benchmark.fetch_testset()))


def _object_class(category: str, file: Path) -> Any:
    from robosuite.models.objects import MujocoXMLObject

    class AddedObject(MujocoXMLObject):  # type: ignore[misc]
        """A model of the archive as the benchmark's code loads it."""

        def __init__(self, name: str = category):
            joints = [{"type": "free", "damping": "0.0005"}]
            super().__init__(str(file), name=name, joints=joints, obj_type="all", duplicate_collision_geoms=False)
            self.category_name = category
            self.object_properties: dict[str, Any] = {"vis_site_names": {}}
            self.rotation, self.rotation_axis = ROTATION_RAD, None

        def _get_object_subtree(self) -> Any:
            """The body ``object``; robosuite expects it in another body, these models may have it at the top."""
            if self.worldbody.find("./body/body[@name='object']") is not None:
                return super()._get_object_subtree()
            body = self.worldbody.find("./body[@name='object']")
            if body is None:
                raise PipelineError("the model has no body 'object'", where=file)
            holder = ET.SubElement(self.worldbody, "body")
            holder.append(body)
            subtree = super()._get_object_subtree()
            self.worldbody.remove(holder)
            return subtree

    return AddedObject
