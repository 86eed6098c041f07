"""LIBERO-Plus's test tasks, rebuilt from their parameters exactly as the benchmark's code builds them.

Tasks that change the camera, the robot, the noise, the instruction or the poses of objects need only LIBERO's assets.
62 of the background tasks also need only LIBERO's assets. The other tasks of background, light and layout (confounding
objects) need scenes, images and models of LIBERO-Plus's asset archive, which replaces LIBERO's assets in the benchmark.
The archive is ``assets.zip``, 6.4 GB, in the dataset Sylvest/LIBERO-plus on the hub. The file names that a task needs
are read from the benchmark's code, as text.
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
from pipeline.axes import AXES, Perturbation, level_of_test
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

RUNNABLE = tuple(name for name, axis in AXES.items() if axis.dimension and axis.test_scene in ("libero", "bddl"))
"""Axes whose test tasks can all be rebuilt without the benchmark's asset archive: 6,983 tasks."""

DECIMALS = 4
"""Number of decimals to which the benchmark rounds its camera after each turn."""

ROTATION_RAD = {"x": (-np.pi / 2, -np.pi / 2), "y": (-np.pi, -np.pi), "z": (np.pi, np.pi)}
"""Ranges of angles by which LIBERO's reset turns an added object, equal for all 867 models of the benchmark."""


class TestCamera(CameraPerturbation):
    """Agent view of a test task: rounded after each turn, and rounded even if the camera is not turned.

    Therefore the camera of a task on another axis differs from LIBERO's own by up to 5e-5 (m, and in the quaternion).
    """

    __test__: ClassVar[bool] = False

    def apply(self, model: mujoco.MjModel) -> None:
        """Move the model's agent view; nothing else in the model changes."""
        camera = model.camera("agentview")
        pos_m, quat_wxyz = camera.pos.copy(), camera.quat.copy()
        # The steps follow the benchmark's order; each step leaves the other parameters neutral.
        for step in self._steps():
            placed_m, turned_wxyz = step.pose(pos_m, quat_wxyz / np.linalg.norm(quat_wxyz))
            pos_m, quat_wxyz = _rounded(placed_m), _rounded(turned_wxyz)
        # The benchmark turns with SciPy's ``Rotation``, which normalises the quaternion.
        camera.pos[:], camera.quat[:] = pos_m, quat_wxyz / np.linalg.norm(quat_wxyz)

    def _steps(self) -> list[CameraPerturbation]:
        """List the changes of the camera, one parameter each, in the benchmark's order."""
        # Angles are in [0, 360) as in the benchmark's names: 330 rounds halves differently than -30.
        # Yaw and pitch turn the orientation alone, about the world's axes, as ``pose`` does.
        steps = {
            "elevation_deg": self.elevation_deg,
            "azimuth_deg": self.azimuth_deg % 360,
            "distance_scale": self.distance_scale,
            "yaw_deg": self.yaw_deg % 360,
            "pitch_deg": self.pitch_deg % 360,
        }
        # A neutral parameter causes no step and so no rounding, except the azimuth, which always causes a step.
        neutral = {"elevation_deg": 0, "distance_scale": 1, "yaw_deg": 0, "pitch_deg": 0}
        changes: list[CameraPerturbation] = []
        for name, value in steps.items():
            if value != neutral.get(name):
                fields = {"component": self.component, "level": self.level, name: value}
                changes.append(CameraPerturbation.model_validate(fields))
        return changes


def _rounded(numbers: Floats) -> Floats:
    """Round each number to ``DECIMALS`` with Python's own ``round``, as the benchmark does."""
    return np.array([round(float(number), DECIMALS) for number in numbers])


def camera(test: TestTask) -> TestCamera:
    """Return the agent view of a test task on any axis."""
    if test.axis != "camera":
        return TestCamera(component="orientation", level=1)
    return TestCamera.model_validate({"component": test.component, "level": level_of_test(test), **test.parameters})


def noise(test: TestTask, seed: int) -> NoisePerturbation:
    """Return the corruption of a noise task.

    Args:
        seed: seed of the parameters that are sampled for every frame: the direction of motion, fog and glass. The
            benchmark samples them from a global generator.
    """
    task_seed = int(seeding.rng("evaluation", seed, "noise", test.suite, test.name).integers(2**53))
    fields = {
        "component": test.component,
        "effect": effect_of(test),
        "level": level_of_test(test),
        "seed": task_seed,
    }
    return NoisePerturbation.model_validate(fields)


def frame_changes(test: TestTask, seed: int) -> tuple[Perturbation, ...]:
    """Return the changes of the frames of a test task in its scene: the agent view, and the corruption of a noise task.

    Args:
        seed: seed of the noise, see ``noise``.
    """
    if test.axis == "noise":
        return camera(test), noise(test, seed)
    return (camera(test),)


def posture_rad(test: TestTask) -> tuple[float, ...] | None:
    """Return the (7,) joint angles in which a robot task resets the arm, ``None`` for a test task on another axis."""
    return postures_rad()[int(test.parameters["id"])] if test.axis == "robot" else None


@cache
def postures_rad() -> dict[int, tuple[float, ...]]:
    """Return start number of robot tasks to the (7,) joint angles in the start's class, with all their digits."""
    source = _reader().packed("envs/robots/mounted_panda.py").decode()
    listed = re.findall(r"class MountedPanda(\d+)\(.*?np\.array\(\[([^\]]+)\]\)", source, flags=re.DOTALL)
    return {int(number): tuple(map(float, row.split(","))) for number, row in listed}


def bddl_text(test: TestTask) -> str:
    """Return the text of the BDDL file that defines the scene of a pose or layout task."""
    return _reader().packed(f"bddl_files/{test.suite}/{test.name}.bddl").decode()


def moved_state(suite: str, name: str) -> Floats:
    """Return the (S,) initial state of a task that moves objects; each such task has one state."""
    return saved_array(_reader().packed(f"init_files/libero_newobj/{suite}/{name}.pruned_init")).reshape(-1)


def saved_array(content: bytes) -> Floats:
    """Read an array that ``torch.save`` wrote as a pickle, with PyTorch's own reader, which runs no code of the pickle.

    Raises:
        UnpicklingError: if the pickle names anything that is not needed for an array of numbers.
    """
    import torch  # takes seconds, and few tasks need it

    reconstruct: Any = np.empty(0).__reduce__()[0]
    named = (reconstruct, "numpy.core.multiarray._reconstruct")
    with torch.serialization.safe_globals([named, np.ndarray, np.dtype, np.dtypes.Float64DType]):
        return np.asarray(torch.load(io.BytesIO(content), weights_only=True), np.float64)


def instruction(test: TestTask, prompt: Prompt) -> str:
    """Return the instruction of a test task.

    A language task has its own wording, except with the prompt ``blank``, which makes every instruction empty.
    """
    if prompt == "blank":
        return ""
    if test.axis == "language":
        return str(test.parameters["text"])
    if prompt == "clean":
        return find_task(test.suite, test.base).instruction
    # Example of a name: KITCHEN_SCENE3_turn_on_the_stove.
    return re.sub(r"^[A-Z].*?SCENE\d+_", "", test.name).replace("_", " ")


def assets_of(test: TestTask, archive: Path | None = None) -> Path | None:
    """Return LIBERO's assets or the archive: the first that has all files that a test task names.

    Return `None` if neither has the files, so that the task cannot be rebuilt.

    Args:
        archive: folder of the unpacked archive, if there is one.
    """
    for folder in (libero_assets(), archive):
        if folder is not None and all((unpacked(folder) / path).is_file() for path in _named(test)):
            return unpacked(folder)
    return None


@cache
def unpacked(folder: Path) -> Path:
    """Find the folder with ``scenes``, ``textures`` and ``new_objects`` at or below a folder.

    The archive stores its files below their path on the machine that packed the archive. Therefore ``folder`` may be
    any folder on this path.

    Raises:
        PipelineError: if there is no such folder.
    """
    root = folder
    while not (root / "scenes").is_dir():
        below = [path for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
        if len(below) != 1:
            raise PipelineError(
                "the folder is not the unpacked asset archive of LIBERO-Plus",
                where=root,
                expected="a folder with scenes, textures and new_objects, or one that leads to it",
                remedy="unpack assets.zip of the dataset Sylvest/LIBERO-plus, and name that folder",
            )
        (root,) = below
    return root.resolve()


def register_objects(test: TestTask, assets: Path) -> None:
    """Register the objects that a layout task adds with LIBERO, under the categories of its BDDL file."""
    control_env()  # imports LIBERO in the right way
    from libero.libero.envs.base_object import OBJECTS_DICT

    for category, path in object_models(test).items():
        OBJECTS_DICT[category] = _object_class(category, assets / path)


def contents(test: TestTask, archive: Path | None) -> list[str]:
    """Compute the SHA-256 of each file of LIBERO's assets or the archive that a test task uses.

    The list starts with the files that the task names, followed by the files to which those refer.
    """
    assets = assets_of(test, archive)
    files = [] if assets is None else [assets / path for path in _named(test)]
    # The loop also visits the files that it appends.
    for file in files:
        if file.suffix == ".xml":
            read = (file.parent / path for path in _referred(edition(file)))
            files += [path.resolve() for path in read if path.is_file() and path.resolve() not in files]
    return [checksum_of(edition(file)) for file in files]


def _named(test: TestTask) -> Iterable[str]:
    """List the asset files that a test task names, by their paths in the archive."""
    match AXES[test.axis].test_scene:
        case "bddl and models":
            return object_models(test).values()
        case "scene files":
            return scene_files(test)
        case _:
            return ()


@cache
def _referred(file: Edition) -> tuple[str, ...]:
    """List the files to which an MJCF file refers.

    Raises:
        PipelineError: if the file is not XML.
    """
    try:
        return tuple(element.attrib["file"] for element in ET.parse(file.path).iterfind(".//*[@file]"))
    except ET.ParseError as error:
        raise PipelineError(
            f"the file is not XML ({error})", where=file.path, remedy="unpack the archive again"
        ) from error


def scene_files(test: TestTask) -> SceneFiles:
    """Return the scene files of a light or background task, by their paths in the archive."""
    return _reader().scene_files(test.suite, test.name)


def object_models(test: TestTask) -> dict[str, str]:
    """Return category to MJCF file, by its path in the archive, of the objects that a layout task adds."""
    models = _reader().object_models
    return {category: models[category] for category in str(test.parameters["category"]).split(",")}


@cache
def _reader() -> Reader:
    """Return the reader of the benchmark's code."""
    return Reader(zipfile.ZipFile(benchmark.fetch_testset()))


def _object_class(category: str, file: Path) -> Any:
    """Return a robosuite class for a model of the archive."""
    from robosuite.models.objects import MujocoXMLObject

    class AddedObject(MujocoXMLObject):  # type: ignore[misc]
        """Model of the archive, loaded like in the benchmark's code."""

        def __init__(self, name: str = category):
            joints = [{"type": "free", "damping": "0.0005"}]
            super().__init__(str(file), name=name, joints=joints, obj_type="all", duplicate_collision_geoms=False)
            self.category_name = category
            self.object_properties: dict[str, Any] = {"vis_site_names": {}}
            self.rotation, self.rotation_axis = ROTATION_RAD, None

        def _get_object_subtree(self) -> Any:
            """Return the body ``object``.

            robosuite expects this body inside another body, but these models may have it at the top.

            Raises:
                PipelineError: if the model has no such body.
            """
            if self.worldbody.find("./body/body[@name='object']") is not None:
                return super()._get_object_subtree()
            body = self.worldbody.find("./body[@name='object']")
            if body is None:
                raise PipelineError(
                    "the model has no body 'object'",
                    where=file,
                    expected="<body name='object'>, below <worldbody> or below a body of it",
                    remedy="unpack the asset archive of LIBERO-Plus again",
                )
            holder = ET.SubElement(self.worldbody, "body")
            holder.append(body)
            subtree = super()._get_object_subtree()
            self.worldbody.remove(holder)
            return subtree

    return AddedObject
