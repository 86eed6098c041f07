"""Test tasks that need the benchmark's asset archive, with a stand-in made of LIBERO's own scenes and objects.

The archive itself cannot be here. The stand-in has its folders and names, so what is tested is which files a task
needs, and that they are used as the benchmark uses them.
"""

import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from libero.libero import get_libero_path
from short_demonstrations import STOVE

from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.libero_plus import moved_state
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task
from pipeline.testset.benchmark import TestTask, load

LIBERO = Path(get_libero_path("assets"))
ARENAS = {
    "libero_tabletop_manipulation": "libero_tabletop_base_style.xml",
    "libero_kitchen_tabletop_manipulation": "libero_kitchen_tabletop_base_style.xml",
    "libero_living_room_tabletop_manipulation": "libero_living_room_tabletop_base_style.xml",
    "libero_study_tabletop_manipulation": "libero_study_base_style.xml",
    "libero_floor_manipulation": "libero_floor_base_style.xml",
}
DIFFUSE = "0.1 0.2 0.6"
AXES = ("light", "background", "layout")


def stand_in(root: Path, tests: Iterable[TestTask]) -> Path:
    """Write what some test tasks need, under the archive's names; the folder is ``root``."""
    for test in tests:
        if test.axis == "layout":
            for path in libero_plus.object_models(test).values():
                write_model(root / path)
            continue
        files = libero_plus.scene_files(test)
        for image in (files.floor, files.wall):
            (root / image).parent.mkdir(parents=True, exist_ok=True)
            known = LIBERO / image
            shutil.copy(known if known.is_file() else LIBERO / "textures" / "canvas_sky_blue.png", root / image)
        write_scene(root, test, root / files.scene_xml)
    return root


def write_scene(root: Path, test: TestTask, path: Path) -> None:
    """LIBERO's scene of the task, with other lights or another table."""
    base = LIBERO / "scenes" / ARENAS[bddl.read(find_task(test.suite, test.base).bddl_file).problem]
    scene = ET.parse(base)
    for element in scene.iterfind(".//*[@file]"):
        inside = element.get("name") in ("texplane", "tex-wall")
        file = (base.parent / element.attrib["file"]).resolve()
        element.set("file", str(root / "textures" / file.name if inside else file))
        if element.get("name") == "tex-table" and "_table_" in path.name:
            element.set("file", str(LIBERO / "textures" / "marble_floor.png"))
    if test.axis == "light":
        for light in scene.iterfind(".//light"):
            light.set("diffuse", DIFFUSE)
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.write(path)


def write_model(path: Path) -> None:
    """A tin of LIBERO's, with its body at the top, as the archive's models may have it."""
    base = LIBERO / "stable_hope_objects" / "alphabet_soup" / "alphabet_soup.xml"
    model = ET.parse(base)
    for element in model.iterfind(".//*[@file]"):
        element.set("file", str((base.parent / element.attrib["file"]).resolve()))
    world = model.getroot().find("worldbody")
    assert world is not None
    (outer,) = world.findall("body")
    (body,) = outer.findall("body")
    body.extend(outer.findall("site"))
    world.remove(outer)
    world.append(body)
    path.parent.mkdir(parents=True, exist_ok=True)
    model.write(path)


@pytest.fixture(scope="module")
def tasks() -> dict[str, TestTask]:
    """A task of each kind on the stove, and the milk's with another floor."""
    listed = [test for test in load().by_name.values() if test.base == STOVE.name]
    chosen = {axis: next(test for test in listed if test.axis == axis) for axis in AXES}
    floors = (test for test in load().by_name.values() if test.suite == "libero_object")
    chosen["floor"] = next(test for test in floors if test.axis == "background" and not libero_plus.assets_of(test))
    return chosen


@pytest.fixture(scope="module")
def archive(tasks: dict[str, TestTask], tmp_path_factory: pytest.TempPathFactory) -> Path:
    unpacked = tmp_path_factory.mktemp("archive")
    stand_in(unpacked / "home" / "author" / "assets", tasks.values())
    return unpacked


@pytest.fixture(scope="module")
def environment(archive: Path) -> Iterator[EpisodeEnvironment]:
    opened = EpisodeEnvironment(archive=archive)
    yield opened
    opened.close()


def named(test: TestTask) -> EvaluationTask:
    return EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, 0, 0)


@pytest.mark.slow
def test_tasks_are_counted_by_the_files_that_are_there(
    archive: Path, tasks: dict[str, TestTask], capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = Selection(source="libero_plus", axes=("light", "layout"), tasks=(STOVE.name,))
    found = select(chosen, archive)
    assert {tasks["light"].name, tasks["layout"].name} <= {task.name for task in found}
    listed = [test for test in load().by_name.values() if test.base == STOVE.name]
    lights = sum(test.axis == "light" for test in listed)
    assert sum(task.axis == "light" for task in found) == 1
    assert f"light {lights - 1}" in capsys.readouterr().out
    with pytest.raises(PipelineError, match="--assets DIR"):
        select(chosen)
    with pytest.raises(PipelineError, match="a folder with scenes"):
        select(chosen, archive / "home" / "author" / "assets" / "new_objects")


def test_files_are_those_that_the_benchmarks_classes_name() -> None:
    by_name = load().by_name
    kitchen = next(test for (_, name), test in by_name.items() if name.startswith("KITCHEN") and "_tb_" in name)
    files = libero_plus.scene_files(kitchen)
    assert files.scene_xml.startswith("scenes/kitchenxml/kitchen_table_")
    assert (files.floor, files.wall) == ("textures/gray_ceramic_tile.png", "textures/yellow_linen_wall_texture.png")
    light = next(test for test in by_name.values() if test.axis == "light" and test.suite == "libero_object")
    assert libero_plus.scene_files(light).scene_xml == (
        f"scenes/lights/floor_light_sync_modified_{light.parameters['number']}.xml"
    )
    added = [test for test in by_name.values() if test.axis == "layout"]
    paths = {path for test in added for path in libero_plus.object_models(test).values()}
    assert len(paths) == 13
    assert "new_objects/bag_of_yeast/ibvtik/usd/MJCF/ibvtik.xml" in paths


def test_results_depend_on_the_files_of_their_task_wherever_they_are(
    tasks: dict[str, TestTask], tmp_path: Path
) -> None:
    one = stand_in(tmp_path / "one", tasks.values())
    two = shutil.copytree(one, tmp_path / "two")
    for axis in AXES:
        assert libero_plus.contents(tasks[axis], one) == libero_plus.contents(tasks[axis], two)
    scene = two / libero_plus.scene_files(tasks["light"]).scene_xml
    scene.write_text(scene.read_text().replace(DIFFUSE, "0.9 0.9 0.9"))
    (two / libero_plus.scene_files(tasks["background"]).wall).write_bytes(b"another image")
    model = two / next(iter(libero_plus.object_models(tasks["layout"]).values()))
    described = ET.parse(model)
    mesh = next(described.iterfind(".//*[@file]"))
    copied = Path(shutil.copy(mesh.attrib["file"], model.parent))
    mesh.set("file", copied.name)
    described.write(model)
    with_copy = libero_plus.contents(tasks["layout"], two)
    copied.write_bytes(b"another mesh")
    assert libero_plus.contents(tasks["layout"], two) != with_copy, "what a file refers to counts too"
    for axis in AXES:
        assert libero_plus.contents(tasks[axis], one) != libero_plus.contents(tasks[axis], two), axis


@pytest.mark.slow
def test_scenes_of_the_archive_are_seen(environment: EpisodeEnvironment, tasks: dict[str, TestTask]) -> None:
    clean = EvaluationTask("libero", STOVE.suite, STOVE.name, "clean", "clean", "clean", 0, 0)
    environment.reset(clean)
    state, seen = environment.simulator.state, environment.image("wrist").copy()
    for axis in ("light", "background"):
        environment.reset(named(tasks[axis]))
        assert np.array_equal(environment.simulator.state, state), "what it looks like changes no state"
        assert not np.array_equal(environment.image("wrist"), seen)
        if axis == "light":
            diffuse = environment.simulator.model.light_diffuse
            assert np.allclose(diffuse, [float(number) for number in DIFFUSE.split()])
    environment.reset(named(tasks["floor"]))
    assert environment.image("agentview")[..., 2].mean() > environment.image("agentview")[..., 0].mean(), "a blue floor"


@pytest.mark.slow
def test_added_objects_start_where_the_benchmark_puts_them(
    environment: EpisodeEnvironment, tasks: dict[str, TestTask]
) -> None:
    test = tasks["layout"]
    environment.reset(named(test))
    category, *_ = str(test.parameters["category"]).split(",")
    first = environment.simulator.model.joint(f"{category}_1_joint0").qposadr[0]
    start_m = moved_state(test.suite, test.name)[1 + first : 1 + first + 3]
    now_m = environment.simulator.state[1 + first : 1 + first + 3]
    assert np.abs(now_m - start_m)[:2].max() < 0.1
    assert now_m[2] < start_m[2] - 0.05, "it falls while things settle"
    environment.step(np.zeros(7))
    assert not environment.progress.over
