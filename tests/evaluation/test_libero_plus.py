"""Test tasks are set up as LIBERO-Plus sets them up: its formulas, written here with what it computes them with."""

import ast
import re
from collections import Counter
from functools import cache

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.evaluation import libero_plus
from pipeline.libero.assets import libero_folder
from pipeline.testset.benchmark import TestTask, load
from pipeline.types import Floats

CENTRE_M = np.array([0.0, 0.0, 0.8])
Pose = tuple[list[float], list[float]]
"""Position in m, quaternion (w, x, y, z)."""


@cache
def nominal(problem: str) -> Pose:
    """The agent view that LIBERO gives the arena of a scene's class, by its source."""
    source = (libero_folder() / "envs/problems" / f"{problem}.py").read_text()
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        given = {keyword.arg: keyword.value for keyword in call.keywords}
        if "camera_name" in given and ast.literal_eval(given["camera_name"]) == "agentview":
            return ast.literal_eval(given["pos"]), ast.literal_eval(given["quat"])
    raise ValueError(f"{problem} has no agent view")


def problem(test: TestTask) -> str:
    """By suite and name, as LIBERO has them."""
    if test.suite != "libero_10":
        return "libero_floor_manipulation" if test.suite == "libero_object" else "libero_tabletop_manipulation"
    scene = re.split(r"_SCENE\d", test.base)[0].lower()
    return f"libero_{scene}_tabletop_manipulation"


def compiled(pose: Pose) -> mujoco.MjModel:
    """A world that has an agent view and no more."""
    pos, quat = (" ".join(map(repr, numbers)) for numbers in pose)
    camera = f'<camera name="agentview" pos="{pos}" quat="{quat}"/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{camera}</worldbody></mujoco>")


def rounded(numbers: Floats) -> list[float]:
    return [round(number, 4) for number in numbers.tolist()]


def turned(turn: Rotation, quat_wxyz: list[float]) -> list[float]:
    return rounded((turn * Rotation.from_quat(quat_wxyz, scalar_first=True)).as_quat(scalar_first=True))


def about_y(degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(-degrees) * np.array([0, 1, 0]))


def about_z(degrees: float) -> Rotation:
    return Rotation.from_euler("z", degrees, degrees=True)


def benchmark_camera(test: TestTask) -> Pose:
    """`Problem._setup_camera` of LIBERO-Plus for a name's azimuth, elevation, distance in percent, yaw and pitch."""
    view = re.search(r"_view_(\d+)_(\d+)_(\d+)_(\d+)_(\d+)_", test.name)
    azimuth, elevation, percent, yaw, pitch = map(int, view.groups()) if view else (0, 0, 100, 0, 0)
    pos, quat = nominal(problem(test))
    if elevation:
        pos = rounded(about_y(elevation).apply(np.array(pos) - CENTRE_M) + CENTRE_M)
        quat = turned(about_y(elevation), quat)
    pos, quat = rounded(about_z(azimuth).apply(pos)), turned(about_z(azimuth), quat)
    if percent != 100:
        pos = rounded(CENTRE_M + (np.array(pos) - CENTRE_M) * (percent / 100))
    if yaw:
        quat = turned(about_z(yaw), quat)
    if pitch:
        quat = turned(about_y(pitch), quat)
    return pos, quat


@pytest.mark.slow
def test_every_camera_is_the_benchmarks() -> None:
    tests = [test for test in load().by_name.values() if test.axis == "camera"]
    assert len(tests) == 1599
    different = {}
    # And of each arena a task that changes something else.
    others = {problem(test): test for test in load().by_name.values() if test.axis != "camera"}
    assert len(others) == 5
    for test in (*tests, *others.values()):
        ours, theirs = compiled(nominal(problem(test))), compiled(benchmark_camera(test))
        libero_plus.camera(test).apply(ours)
        if not (np.array_equal(ours.cam_pos, theirs.cam_pos) and np.array_equal(ours.cam_quat, theirs.cam_quat)):
            different[test.suite, test.name] = (ours.cam_pos, theirs.cam_pos, ours.cam_quat, theirs.cam_quat)
    kinds = Counter(load().by_name[key].component for key in different)
    assert not different, f"{kinds} are other cameras, such as {next(iter(different.items()))}"
