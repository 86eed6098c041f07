"""Test tasks planted in a plan are found, on every axis, and stop the run; what cannot be known is said."""

import json
import math
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable
from contextlib import chdir
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkout import REPOSITORY
from short_runs import tiny_config

from pipeline import seeding
from pipeline.axes import AXES, Perturbation, from_json, to_json
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.language import LanguagePerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.pose import PoseAxis, displacements
from pipeline.axes.robot import benchmark_offsets_rad
from pipeline.errors import PipelineError
from pipeline.evaluation.held_out import PlannedPerturbations
from pipeline.libero.starts import HOME_RAD
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.planning import leakage, plan
from pipeline.planning.plan import Row
from pipeline.planning.sampler import Sampler
from pipeline.run.claim import claim_folder
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Task

FOLDER = REPOSITORY / benchmark.FOLDER

REPEATED: dict[str, Callable[[TestTask], dict[str, Any]]] = {
    "camera": lambda tested: dict(tested.parameters),
    "noise": lambda tested: {
        "effect": {name: value for name, value in tested.parameters.items() if name != "severity"},
        "seed": 1,
    },
    "language": lambda tested: {"component": "paraphrase", **tested.parameters},
    "background": lambda tested: {
        "coverings": [{"part": "surface", "texture": tested.parameters["surface"], "licence": "-", "sha256": "-"}],
        "colour_scale": 1,
    },
    "robot": lambda tested: {"joint_offsets_rad": benchmark_offsets_rad()[int(tested.parameters["id"]) - 1].tolist()},
    "pose": lambda tested: {
        "component": "target",
        "dyaw_deg": 0,
        "moved": tested.parameters["target"],
        **{name: tested.parameters[name] for name in ("dx_m", "dy_m")},
    },
}
"""Axis to the fields of the perturbation that would repeat a test task. Light's values are in no file of the wheel."""


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load(FOLDER)


def repeated(tested: TestTask) -> Perturbation:
    """The test task as if the planner had sampled it."""
    fields = {"axis": tested.axis, "component": tested.component, "level": 1, **REPEATED[tested.axis](tested)}
    (perturbation,) = from_json(json.dumps([fields]))
    return perturbation


def row(task: Task, perturbations: Iterable[Perturbation], name: str) -> Row:
    listed = to_json(perturbations)
    changed = from_json(listed)
    return Row(
        episode_id=name,
        twin_id="twin",
        trajectory_id="trajectory",
        role="perturbed",
        suite=task.suite,
        task=task.name,
        demo_id=f"{task.suite}/{task.name}/demo_0",
        demo_sha256="0",
        demo_source="test",
        demo_origin="human",
        demo_origin_sha256="0",
        demo_steps=100,
        axis="+".join(p.axis for p in changed),
        component="+".join(p.component for p in changed),
        level="+".join(str(p.level) for p in changed),
        perturbations=listed,
        instruction=task.instruction,
        rank=0,
        wanted=True,
        seed=0,
        variant=0,
    )


@pytest.mark.parametrize("axis", [axis for axis in AXES if axis in REPEATED])
def test_every_test_task_is_found_when_it_is_sampled(axis: str, test: TestSet) -> None:
    known = [tested for tested in test.on_axis(axis) if axis != "pose" or "target" in tested.parameters]
    assert len(known) > 600
    rows = [row(find_task(tested.suite, tested.base), [repeated(tested)], f"{n}") for n, tested in enumerate(known)]
    finding = leakage.check(rows, test)[axis]
    assert finding.overlaps == finding.rows == len(known)
    assert finding.test_tasks == len(test.on_axis(axis))
    assert finding.verdict == "overlap"
    assert finding.smallest == pytest.approx(0, abs=1e-5)


def test_every_test_scene_is_found_when_it_is_sampled(test: TestSet) -> None:
    """With everything that it moves; and its other moves keep it apart from a scene that only the target's fits."""
    rows = []
    for number, tested in enumerate(test.on_axis("pose")):
        moves = [{"name": name, "dx_m": dx, "dy_m": dy} for name, (dx, dy) in displacements(tested.parameters).items()]
        fields = {"axis": "pose", "component": "scene", "level": 1, "moves": moves}
        rows.append(row(find_task(tested.suite, tested.base), from_json(json.dumps([fields])), f"{number}"))
    finding = leakage.check(rows, test)["pose"]
    assert (finding.overlaps, finding.rows, finding.not_compared) == (696, 696, 0)
    assert finding.smallest == pytest.approx(0, abs=1e-5)
    assert finding.coverage["pose"].compared == 696


def test_a_test_scene_is_found_on_every_task_that_begins_in_it(test: TestSet) -> None:
    """LIBERO-90 has 35 tasks in scenes of the long suite; all of the goal suite begin in one."""
    stove = "KITCHEN_SCENE3_turn_on_the_stove"
    tested = test.on(find_task("libero_10", f"{stove}_and_put_the_moka_pot_on_it"), "pose")[0]
    moves = [{"name": name, "dx_m": dx, "dy_m": dy} for name, (dx, dy) in displacements(tested.parameters).items()]
    planted = from_json(json.dumps([{"axis": "pose", "component": "scene", "level": 1, "moves": moves}]))
    same, another = (
        find_task("libero_90", stove),
        find_task("libero_90", "KITCHEN_SCENE1_put_the_black_bowl_on_the_plate"),
    )
    assert planted[0].nearest(test, same).distance == 0
    held_clear = PlannedPerturbations([row(same, planted, "planned")])
    assert held_clear.nearest(planted[0], find_task(tested.suite, tested.base)) == (0, "planned")
    assert held_clear.nearest(planted[0], another) == (math.inf, "")
    both = [row(same, planted, "planted"), row(another, planted, "elsewhere")]
    found = leakage.check(both, test)["pose"]
    assert (found.overlaps, found.not_compared, found.closest, found.verdict) == (1, 1, "planted", "overlap")

    bowl = repeated(test.on(find_task("libero_goal", "put_the_bowl_on_the_plate"), "pose")[0])
    assert bowl.nearest(test, find_task("libero_goal", "put_the_bowl_on_the_stove")).distance == 0


def test_coverage_counts_the_episodes_that_were_kept(test: TestSet) -> None:
    """Of two cameras, on either side of the test camera at an azimuth of 30 degrees, the nearer one is dropped."""
    bowl = find_task("libero_goal", "put_the_bowl_on_the_plate")
    cameras = [
        CameraPerturbation(component="spherical", level=3, azimuth_deg=azimuth_deg, yaw_deg=yaw_deg)
        for azimuth_deg, yaw_deg in ((30.0, 6.0), (30.0, 9.0))
    ]
    planned = leakage.check([row(bowl, [camera], str(camera.yaw_deg)) for camera in cameras], test)
    findings = json.loads(json.dumps({axis: asdict(finding) for axis, finding in planned.items()}))
    kept = [{"suite": bowl.suite, "task": bowl.name, "perturbations": to_json([cameras[1]])}]
    covered = leakage.covered_by(kept, findings, test)["camera"]
    assert findings["camera"]["coverage"]["spherical"]["smallest"] == pytest.approx(6.0)
    assert covered["coverage"]["spherical"]["smallest"] == pytest.approx(9.0)
    assert {**covered, "coverage": None} == {**findings["camera"], "coverage": None}


@pytest.mark.slow
def test_scenes_keep_their_clearance_from_every_test_scene_and_cover_them_all(test: TestSet) -> None:
    axis, rows = PoseAxis(components=("scene",)), []
    for suite in SUITES[:4]:
        for task in tasks(suite):
            samples = islice(Sampler("pose", (axis,), 5, test).sample(task.name, task), 20)
            rows += [row(task, perturbations, f"{task.name}{number}") for number, perturbations in enumerate(samples)]
    finding = leakage.check(rows, test)["pose"]
    assert (finding.rows, finding.overlaps, finding.verdict) == (800, 0, "disjoint")
    assert finding.smallest is not None
    assert finding.smallest >= finding.clearance == 0.01
    covered = finding.coverage["pose"]
    assert covered.compared == 696
    # The bowl of the goal suite is out of the hand's reach where the benchmark puts it.
    assert covered.median is not None
    assert covered.median < 0.08


@pytest.mark.parametrize("axis", AXES)
def test_perturbations_mostly_keep_their_clearance_and_the_rest_is_counted(axis: str, test: TestSet) -> None:
    sampled_axis = AXES[axis]()
    rows, overlaps = [], 0
    changed = [task for suite in SUITES[:4] if sampled_axis.applies(task := tasks(suite)[3])]
    assert len(changed) > 1
    for task in changed:
        suite = task.suite
        for variant in range(40):
            perturbation = sampled_axis.sample(seeding.rng(5, axis, suite, variant), task, variant)
            assert 1 <= perturbation.level <= 5
            overlaps += perturbation.nearest(test, task).distance < perturbation.clearance
            rows.append(row(task, [perturbation], f"{suite}{variant}"))
    finding = leakage.check(rows, test)[axis]
    assert (finding.rows, finding.overlaps, finding.test_tasks) == (
        40 * len(changed),
        overlaps,
        len(test.on_axis(axis)),
    )
    assert finding.measure
    assert overlaps <= 16
    assert finding.not_compared == (160 if axis in ("light", "disturbance") and finding.test_tasks else 0)
    if finding.comparisons:
        assert finding.verdict == ("overlap" if overlaps else "disjoint")


def test_coverage_is_the_distance_of_test_tasks_to_what_is_wanted(test: TestSet) -> None:
    task = find_task("libero_goal", "turn_on_the_stove")

    def gaussian(sigma_px: float) -> Row:
        effect = {"sigma_px": sigma_px}
        fields = {"axis": "noise", "component": "gaussian_blur", "level": 1, "effect": effect, "seed": 1}
        return row(task, from_json(json.dumps([fields])), f"{sigma_px}")

    # In steps: the weak one stands half a step from severity 1 and 8.5 from severity 10, the reserve does not count.
    rows = [gaussian(1.5), replace(gaussian(9.5), wanted=False)]
    found = leakage.check(rows, test)["noise"].coverage
    assert set(found) == {"motion", "gaussian_blur", "zoom", "fog", "glass"}
    assert (found["fog"].test_tasks, found["fog"].compared, found["fog"].median) == (272, 0, None)
    assert (found["gaussian_blur"].test_tasks, found["gaussian_blur"].compared) == (341, 341)
    assert (found["gaussian_blur"].smallest, found["gaussian_blur"].largest) == (0.5, 8.5)
    severities = [
        int(tested.parameters["severity"]) for tested in test.on_axis("noise") if tested.component == "gaussian_blur"
    ]
    away = sorted(abs(severity - 1.5) for severity in severities)
    # Places 170 and 306 of 0 to 340.
    assert (found["gaussian_blur"].median, found["gaussian_blur"].p90) == (away[170], away[306])
    # Each test task counts with the nearest episode.
    both = leakage.check([replace(one, wanted=True) for one in rows], test)["noise"].coverage["gaussian_blur"]
    assert (both.largest, both.compared) == (3.5, 341)


def test_coverage_is_by_task_where_a_task_has_test_tasks_of_its_own(test: TestSet) -> None:
    language = test.on_axis("language")[0]
    task = find_task(language.suite, language.base)
    (found,) = leakage.check([row(task, [repeated(language)], "one")], test)["language"].coverage.values()
    assert (found.test_tasks, found.compared, found.smallest) == (1537, len(test.on(task, "language")), 0)


@pytest.mark.parametrize("axis", ["light", "background", "layout"])
def test_where_near_cannot_be_told_from_far_there_is_no_coverage(axis: str, test: TestSet) -> None:
    task = tasks(SUITES[2])[3]
    perturbation = AXES[axis]().sample(seeding.rng(5, axis), task, 0)
    coverage = leakage.check([row(task, [perturbation], "one")], test)[axis].coverage
    assert {(found.compared, found.median) for found in coverage.values()} == {(0, None)}


@pytest.mark.parametrize("robot", ["mounted_panda", "on_the_ground_panda"])
def test_the_robot_axis_knows_the_benchmarks_postures(robot: str) -> None:
    with zipfile.ZipFile(FOLDER / benchmark.WHEEL) as wheel:
        source = wheel.read(f"liberoplus/liberoplus/envs/robots/{robot}.py").decode()
    pattern = r"^class \w+?Panda(\d+)\([^#]*?return np\.array\(\[([^\]]*)\]"
    found = {int(name): [float(angle) for angle in row.split(",")] for name, row in re.findall(pattern, source, re.M)}
    assert sorted(found) == list(range(1, 501))
    postures_rad = np.array([found[name] for name in sorted(found)])
    assert np.abs(postures_rad - HOME_RAD - benchmark_offsets_rad()).max() < 1e-8


def test_a_row_with_several_perturbations_counts_for_each_axis(test: TestSet) -> None:
    language, noise = (next(iter(test.on_axis(axis))) for axis in ("language", "noise"))
    task = find_task(language.suite, language.base)
    clean = row(task, [], "clean")
    both = row(task, [repeated(noise), repeated(language)], "both")
    findings = leakage.check([clean, both], test)
    assert {axis: (f.rows, f.overlaps, f.closest) for axis, f in findings.items()} == {
        "noise": (1, 1, "both"),
        "language": (1, 1, "both"),
    }


def test_a_combination_overlaps_where_one_of_its_parts_does(test: TestSet) -> None:
    language = test.on_axis("language")[0]
    task = find_task(language.suite, language.base)
    clear = NoiseAxis().sample(seeding.rng(1), task, 0)
    findings = leakage.check([row(task, [clear, repeated(language)], "both")], test)
    assert {axis: (f.rows, f.overlaps, f.verdict) for axis, f in findings.items()} == {
        "noise": (1, 0, "disjoint"),
        "language": (1, 1, "overlap"),
    }


def test_a_plan_of_another_version_is_named(test: TestSet) -> None:
    task = find_task("libero_goal", "turn_on_the_stove")
    noise = row(task, [NoiseAxis().sample(seeding.rng(1), task, 0)], "old")
    for was, now, fault in (
        ('"seed":', '"sead":', r"noise\.seed: Field required"),
        ('"axis":"noise"', '"axis":"snow"', "'snow'"),
        ("[{", "{", "Invalid JSON"),
    ):
        old = replace(noise, perturbations=noise.perturbations.replace(was, now))
        with pytest.raises(
            PipelineError, match=f"not perturbations of this version: .*{fault}(?s:.*)which plans again"
        ):
            leakage.check([old], test)


def test_an_axis_that_cannot_be_compared_is_not_called_disjoint(test: TestSet) -> None:
    noise = next(iter(test.on_axis("noise")))
    task = find_task(noise.suite, noise.base)
    other = next(tested for tested in test.on_axis("noise") if tested.component != noise.component)
    rows = [row(task, [repeated(noise)], "one")]
    # The test set has tasks of the axis, but none to compare this with.
    assert leakage.check(rows, TestSet((other,)))["noise"].verdict == "unknown"
    assert leakage.check(rows, TestSet((other,)))["noise"].smallest is None
    assert leakage.check(rows, TestSet(()))["noise"].verdict == "no test tasks"
    assert leakage.check([], test) == {}
    severity = other.parameters["severity"]
    near = next(
        one
        for one in test.on_axis("noise")
        if one.component == other.component and one.parameters["severity"] != severity
    )
    some = leakage.check([*rows, row(task, [repeated(near)], "two")], TestSet((other,)))["noise"]
    assert (some.not_compared, some.verdict) == (1, "disjoint where compared")


def run_stage(folder: Path, rows: list[Row], **axes: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """The stage as DVC runs it, on a plan of these rows, with other settings of some axes."""
    (folder / "data").mkdir(exist_ok=True)
    if not (folder / benchmark.FOLDER).exists():
        (folder / benchmark.FOLDER).symlink_to(FOLDER)
    config = tiny_config(folder / "demos")
    config["plan"]["axes"] |= axes
    (folder / "tiny.yaml").write_text(yaml.safe_dump(config))
    with chdir(folder):
        claim_folder(Path("tiny.yaml"))
    plan.write(rows, folder / "data" / "tiny" / "plan.parquet")
    command = [sys.executable, str(REPOSITORY / "stages" / "leakage.py"), "tiny.yaml"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_stage_stops_where_an_episode_overlaps(test: TestSet, tmp_path: Path) -> None:
    task = find_task("libero_goal", "turn_on_the_stove")
    clear = [row(task, [NoiseAxis().sample(seeding.rng(n), task, n)], f"{n}") for n in range(9)]
    done = run_stage(tmp_path, clear)
    assert done.returncode == 0, done.stderr
    assert re.search(r"noise +9 +1,601 +0 +0\.[45] +0\.25 +disjoint", done.stdout), done.stdout
    assert "noise: steps between the benchmark's severities" in done.stdout
    assert re.search(r"noise +gaussian_blur +341 +0\.5 +", done.stdout), done.stdout
    report = json.loads((tmp_path / "data" / "tiny" / "leakage.json").read_text())
    assert (report["noise"]["overlaps"], report["noise"]["verdict"]) == (0, "disjoint")
    assert report["noise"]["smallest"] >= report["noise"]["clearance"]

    planted = row(task, [repeated(test.on(task, "language")[0])], "planted")
    done = run_stage(tmp_path, [*clear, planted])
    assert done.returncode == 1
    clearance = f"clearance {LanguagePerturbation.clearance:g}"
    assert f"1 of 1 on the language axis (such as planted, distance 0, {clearance})" in done.stderr
    assert "noise axis" not in done.stderr
    report = json.loads((tmp_path / "data" / "tiny" / "leakage.json").read_text())
    assert (report["language"]["overlaps"], report["language"]["verdict"]) == (1, "overlap")
    assert all(math.isfinite(finding["clearance"]) for finding in report.values())


@pytest.mark.slow
def test_overlapping_cameras_are_reported_if_no_clearance_is_asked_for(test: TestSet, tmp_path: Path) -> None:
    tested = next(iter(test.on_axis("camera")))
    planted = row(find_task(tested.suite, tested.base), [repeated(tested)], "planted")
    done = run_stage(tmp_path, [planted])
    assert (done.returncode, "1 of 1 on the camera axis" in done.stderr) == (1, True)
    assert "pixels" not in done.stdout
    done = run_stage(tmp_path, [planted], camera={"clear_by": "off"})
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "data" / "tiny" / "leakage.json").read_text())
    assert (report["camera"]["overlaps"], report["camera"]["verdict"]) == (1, "overlap")


def test_an_overlap_is_explained_by_what_overlaps() -> None:
    """Kinds differ in clearance: one object keeps 5 mm, a scene 10."""
    task = find_task("libero_goal", "turn_on_the_stove")
    test = TestSet((TestTask(task.suite, task.name, "name", "pose", "pose", {"moves": "plate_1:0,0"}),))
    changed = {"axis": "pose", "level": 1}
    one = {**changed, "component": "target", "moved": "plate_1", "dx_m": 0.0055, "dy_m": 0, "dyaw_deg": 0}
    scene = {**changed, "component": "scene", "moves": [{"name": "plate_1", "dx_m": 0.008, "dy_m": 0}]}
    rows = [row(task, from_json(json.dumps([fields])), str(fields["component"])) for fields in (one, scene)]
    with pytest.raises(PipelineError, match=r"1 of 2 .* \(such as scene, distance 0\.008, clearance 0\.01\)"):
        leakage.reject_overlap(leakage.check(rows, test))


@pytest.mark.parametrize("first", ["target", "scene"])
def test_the_reported_clearance_is_that_of_the_closest_kind(first: str) -> None:
    """A moved target at 6 mm is nearer to the test task than a moved scene at 20 mm; neither overlaps."""
    task = find_task("libero_goal", "turn_on_the_stove")
    test = TestSet((TestTask(task.suite, task.name, "name", "pose", "pose", {"moves": "plate_1:0,0"}),))
    changed = {"axis": "pose", "level": 1}
    target = {**changed, "component": "target", "moved": "plate_1", "dx_m": 0.006, "dy_m": 0, "dyaw_deg": 0}
    scene = {**changed, "component": "scene", "moves": [{"name": "plate_1", "dx_m": 0.02, "dy_m": 0}]}
    listed = sorted((target, scene), key=lambda fields: fields["component"] != first)
    rows = [row(task, from_json(json.dumps([fields])), str(fields["component"])) for fields in listed]
    found = leakage.check(rows, test)["pose"]
    assert (found.overlaps, found.closest, found.clearance) == (0, "target", 0.005)
    assert found.smallest == pytest.approx(0.006)


def test_no_overlap_is_no_error(test: TestSet) -> None:
    leakage.reject_overlap({})
    tested = test.on_axis("noise")[0]
    findings = leakage.check([row(find_task(tested.suite, tested.base), [repeated(tested)], "planted")], test)
    with pytest.raises(PipelineError, match="such as planted"):
        leakage.reject_overlap(findings)
