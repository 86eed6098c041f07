"""Plans from expanded demonstrations keep clear of the test set by where things stand in them, not by the label alone.

Where an object stands is read here from the recorded state, and where a test has it from the benchmark's BDDL files.
"""

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from checkout import REPOSITORY
from short_demonstrations import MILK, starter_demo

from pipeline.axes import from_json, to_json
from pipeline.axes.pose import Move, PosePerturbation, ScenePerturbation
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero import bddl, hdf5
from pipeline.libero.demonstrations import HDF5Source
from pipeline.planning import leakage, plan
from pipeline.testset import benchmark
from pipeline.types import Floats

FOLDER = REPOSITORY / benchmark.FOLDER
DEMONSTRATIONS = 12

X = 1 + 9 + 7 * list(bddl.read(MILK.bddl_file).objects).index("milk_1")
"""Of the milk in a state, after the time and the robot's nine joints: objects follow in the order of the BDDL file."""


def offsets_m() -> list[Floats]:
    """How far each of the expanded demonstrations has the milk from where the starter's has it."""
    rng = np.random.default_rng(3)
    return [rng.uniform(-0.03, 0.03, 2).round(4) for _ in range(DEMONSTRATIONS)]


def write_expanded(root: Path, change: str = "") -> HDF5Source:
    """Recordings as ``demos expand`` writes them, each with the milk elsewhere."""
    starter = starter_demo(MILK)
    recordings = []
    for number, (dx_m, dy_m) in enumerate(offsets_m()):
        states = np.repeat(starter.init_state[None], 5, axis=0)
        states[:, X : X + 2] += (dx_m, dy_m)
        states[:, 0] += number * 1e-6
        moved = PosePerturbation(component="target", level=1, moved="milk_1", dx_m=dx_m, dy_m=dy_m, dyaw_deg=0)
        attrs = {hdf5.EXPANDED_FROM: starter.demo_id, "perturbations": change or to_json([moved])}
        recordings.append(hdf5.Recording(starter.actions[:5], states, np.zeros((5, 9)), "<mujoco/>", {}, attrs))
    hdf5.write(root / MILK.suite / f"{MILK.name}_demo.hdf5", MILK, recordings)
    return HDF5Source(root)


def moves_of_tests_m() -> Floats:
    """(N, 2) how far the test scenes of the task have the milk from LIBERO's place, by the files' text."""

    def centre_m(text: str) -> Floats:
        (corners,) = re.findall(r"\(target_object_region\s+\(:target floor\)\s+\(:ranges \(\s*\(([^)]*)\)", text)
        low_x, low_y, high_x, high_y = map(float, corners.split())
        return np.array([low_x + high_x, low_y + high_y]) / 2

    own = MILK.bddl_file.read_text()
    assert "(On milk_1 floor_target_object_region)" in own
    with zipfile.ZipFile(FOLDER / benchmark.WHEEL) as archive:
        files = (f"liberoplus/liberoplus/bddl_files/{MILK.suite}/{one.name}.bddl" for one in of_the_task())
        return np.array([centre_m(archive.read(file).decode()) - centre_m(own) for file in files])


def of_the_task() -> list[benchmark.TestTask]:
    return [one for one in benchmark.load(FOLDER).on_axis("pose") if (one.suite, one.base) == (MILK.suite, MILK.name)]


@pytest.mark.slow
def test_no_object_stands_where_a_test_has_it(tmp_path: Path) -> None:
    source = write_expanded(tmp_path)
    entries = source.index([MILK]).entries
    config = PlanConfig.model_validate(
        {"axes": {"pose": {"components": ["target"]}}, "episodes": {"pose": 600}, "reserve": 0}
    )
    rows = plan.make(entries, config, ReplayConfig(), benchmark.load(FOLDER))
    starts_m = {one.demo_id: source.load(one.demo_id).init_state[X : X + 2] for one in entries}
    tests_m, nearest_m = moves_of_tests_m(), []
    assert len(tests_m) > 10
    for row in rows:
        for perturbation in from_json(row.perturbations):
            assert isinstance(perturbation, PosePerturbation)
            stands_m = (
                starts_m[row.demo_id]
                - starter_demo(MILK).init_state[X : X + 2]
                + (perturbation.dx_m, perturbation.dy_m)
            )
            nearest_m.append(np.linalg.norm(tests_m - stands_m, axis=1).min())
    assert len(nearest_m) == 600
    assert min(nearest_m) >= PosePerturbation.clearance - 1e-6
    found = leakage.check(rows, benchmark.load(FOLDER))["pose"]
    assert (found.overlaps, found.verdict) == (0, "disjoint")
    assert found.smallest == pytest.approx(min(nearest_m), abs=1e-5)


def test_displacements_of_one_expansion_after_the_other_add_up() -> None:
    first = ScenePerturbation(level=1, moves=(Move(name="a", dx_m=0.01, dy_m=0), Move(name="b", dx_m=0, dy_m=0.02)))
    second = PosePerturbation(component="target", level=1, moved="a", dx_m=0.02, dy_m=0.01, dyaw_deg=0).after([first])
    third = ScenePerturbation(level=1, moves=(Move(name="b", dx_m=0.03, dy_m=0),)).after(from_json(to_json([second])))
    assert second.shifts_in_all == {"a": (0.03, 0.01), "b": (0, 0.02)}
    assert third.shifts_in_all == {"a": (0.03, 0.01), "b": (0.03, 0.02)}
    assert second.shifts == {"a": (0.02, 0.01)}, "the scene is moved by its own part alone"
    unmoved = PosePerturbation(component="target", level=1, moved="a", dx_m=0.02, dy_m=0.01, dyaw_deg=0).after([])
    assert "source_moves" not in unmoved.model_dump_json()


def test_a_reset_of_another_scene_has_none_of_an_expansions_displacements(tmp_path: Path) -> None:
    entries = write_expanded(tmp_path).index([MILK]).entries
    axes = {"goal": {}, "pose": {"components": ["target"]}}
    config = PlanConfig.model_validate({"axes": axes, "episodes": {"goal+pose": 40, "pose": 40}, "reserve": 0})
    moved = {"goal+pose": 0, "pose": 0}
    for row in plan.make(entries, config, ReplayConfig(), benchmark.load(FOLDER)):
        for perturbation in from_json(row.perturbations):
            if isinstance(perturbation, PosePerturbation):
                moved[row.axis] += 1
                assert (perturbation.shifts_in_all == perturbation.shifts) == (row.axis == "goal+pose")
    assert moved == {"goal+pose": 40, "pose": 40}


def test_an_expansion_of_an_unknown_version_is_named(tmp_path: Path) -> None:
    (entry, *_) = write_expanded(tmp_path, '[{"axis":"gravity"}]').index([MILK]).entries
    config = PlanConfig.model_validate({"episodes": {"pose": 1}})
    with pytest.raises(PipelineError, match=rf"{entry.demo_id}: the perturbations of this expanded (?s:.*)gravity"):
        plan.make([entry], config, ReplayConfig(), benchmark.load(FOLDER))
