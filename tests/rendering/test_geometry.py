"""Cameras, depth, segmentation and poses: what the datasets have of them leads from a pixel to the thing it shows."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from checkout import REPOSITORY
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from short_demonstrations import BOWL, STOVE
from short_runs import tiny_config

sys.path.append(str(REPOSITORY / "examples"))

from back_project import back_project

from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.light import LightPerturbation
from pipeline.compute.pool import loop
from pipeline.config import Config, RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.formats.annotations import TRACE_STEPS, event_annotations
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.libero import bddl
from pipeline.planning import plan, selection
from pipeline.planning.streams import Stream
from pipeline.rendering.geometry import COMMON
from pipeline.rendering.render import render
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.export import export
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Rendered, RenderedExtra, Task, Trajectory
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

EXTRAS: tuple[RenderedExtra, ...] = ("boxes", "depth", "object_poses", "segmentation")
MOVED = CameraPerturbation(component="spherical", level=3, azimuth_deg=30.0, elevation_deg=8.0)
DIM = LightPerturbation(component="diffuse", level=1, diffuse_scale_rgb=(0.9, 0.9, 0.9))
STREAMS = {
    "image": Stream("image", ()),
    "wrist_image": Stream("wrist_image", ()),
    "moved": Stream("image", (MOVED,)),
    "dim": Stream("image", (MOVED, DIM)),
}
LEAST_PX = 40
"""Pixels of a thing from which on its place is looked at."""


@pytest.fixture(scope="module")
def middle(whole: dict[Task, Trajectory]) -> Trajectory:
    """Two steps in the middle of a demonstration, where the wrist sees the bowl and the stove."""
    source = whole[STOVE]
    at = slice(10, 13)
    return replace(source, states=source.states[at], site_alpha=source.site_alpha[at], actions=source.actions[10:12])


@pytest.fixture(scope="module")
def rendered(middle: Trajectory, opened: LastScene) -> Rendered:
    return render(middle, STOVE, list(STREAMS.values()), RenderConfig(extras=EXTRAS), opened)


def pixels(file: bytes) -> NDArray[Any]:
    return np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED))


def outside_m(points_m: NDArray[Any], pose: NDArray[Any], model: mujoco.MjModel, body: int) -> NDArray[Any]:
    """How far points (N, 3) in the world are outside of the boxes about the seen geoms of a body with a pose (7,)."""
    local = (points_m - pose[:3]) @ Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()
    off = []
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == 1)):
        turned = Rotation.from_quat(model.geom_quat[geom][[1, 2, 3, 0]]).as_matrix()
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        beyond = np.abs((local - model.geom_pos[geom]) @ turned - centre) - half
        off.append(np.linalg.norm(beyond.clip(0), axis=1))
    return np.asarray(np.min(off, axis=0))


@pytest.mark.parametrize("name", ["image", "wrist_image", "moved"])
def test_depth_leads_to_the_things_that_the_pixels_are_of(name: str, rendered: Rendered, middle: Trajectory) -> None:
    """By the example that the documentation shows, from the stored files alone."""
    stream, model = STREAMS[name], mujoco.MjModel.from_xml_string(middle.model_xml)
    geometry = rendered.geometry[stream.geometry.stream_id]
    depth, ids = (pixels(geometry.maps[extra][1]) for extra in ("depth", "segmentation"))
    assert (str(depth.dtype), str(ids.dtype)) == ("uint16", "uint8")
    view = stream.view
    seen = {f"{view}_depth": depth[..., None], "state": rendered.state[1]}
    matrices = {f"{view}_intrinsics": geometry.intrinsics, f"{view}_extrinsics": geometry.extrinsics}
    points_m = back_project(view, seen, matrices)
    assert rendered.object_poses is not None
    looked_at = set()
    for thing in bddl.read(STOVE.bddl_file).objects:
        place = rendered.instances.index(thing)
        shown, pose = ids == place, rendered.object_poses[1, place]
        if shown.sum() < LEAST_PX:
            continue
        looked_at.add(thing)
        off_m = outside_m(points_m[shown], pose, model, model.body(f"{thing}_main").id)
        assert np.quantile(off_m, 0.99) < 0.003, thing
        # A box about a plate would hold it mirrored too: it is where its body is.
        if name != "wrist_image":
            assert np.linalg.norm((points_m[shown].mean(axis=0) - pose[:3])[:2]) < 0.02, thing
    assert {"akita_black_bowl_1", "cream_cheese_1", "plate_1"} <= looked_at


@pytest.mark.parametrize("name", ["image", "wrist_image", "moved"])
def test_rays_through_the_pixels_meet_the_things_and_the_distances(
    name: str, rendered: Rendered, middle: Trajectory
) -> None:
    """By MuJoCo's ray casting, which renders nothing; also for robot, table, walls and floor."""
    model = mujoco.MjModel.from_xml_string(middle.model_xml)
    data = mujoco.MjData(model)
    data.qpos[:] = middle.states[1, 1 : 1 + model.nq]
    mujoco.mj_forward(model, data)
    geometry = rendered.geometry[STREAMS[name].geometry.stream_id]
    depth_m, ids = pixels(geometry.maps["depth"][1]) * 1e-4, pixels(geometry.maps["segmentation"][1])
    camera = geometry.extrinsics.astype(float)
    if name == "wrist_image":
        hand = np.eye(4)
        hand[:3, :3] = Rotation.from_rotvec(rendered.state[1, 3:6]).as_matrix()
        hand[:3, 3] = rendered.state[1, :3]
        camera = hand @ camera
    from_pixels = np.linalg.inv(geometry.intrinsics.astype(float))
    nearest_m = model.vis.map.znear * model.stat.extent
    seen_geoms, geom, met = np.array([0, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32), set()
    for x, y in np.random.default_rng(0).integers(1, len(ids) - 1, (600, 2)):
        ray = from_pixels @ [x, y, 1.0]  # its z is 1, so multiples of it are distances along the camera's axis
        distance_m = mujoco.mj_ray(model, data, camera[:3, 3].copy(), camera[:3, :3] @ ray, seen_geoms, 1, -1, geom)
        around_m = depth_m[y - 1 : y + 2, x - 1 : x + 2]
        if np.ptp(around_m) > 0.02 or 0 <= distance_m < 1.05 * nearest_m:
            continue  # edges belong to either side, and cameras cut off what is too near
        assert depth_m[y, x] == pytest.approx(distance_m, abs=0.0005), (x, y)
        body = model.body(model.geom_bodyid[geom[0]])
        root = model.body(body.rootid[0]).name
        found = rendered.instances[ids[y, x]]
        met.add(found)
        assert found == expected_name(body.name, root, model.geom(geom[0]).name), (x, y)
    assert {"gripper", "table", "flat_stove_1"} <= met


def expected_name(body: str, root: str, geom: str) -> str:
    """Return the name of the thing that a geom of MuJoCo's model belongs to."""
    if root.endswith("_main"):
        return root.removesuffix("_main")
    parts = {"gripper0_": "gripper", "robot0_": "robot", "mount0_": "robot"}
    for prefix, part in parts.items():
        if body.startswith(prefix):
            return part
    return "table" if root.endswith("table") else geom.rstrip("0123456789").partition("_")[0]


def test_boxes_are_the_least_around_the_pixels_of_the_gripper_and_the_goal(rendered: Rendered) -> None:
    knob = rendered.instances.index("flat_stove_1")
    for name in ("image", "wrist_image"):
        geometry = rendered.geometry[STREAMS[name].geometry.stream_id]
        assert geometry.boxes is not None
        for ids, boxes in zip(map(pixels, geometry.maps["segmentation"]), geometry.boxes, strict=True):
            assert set(np.flatnonzero(boxes.any(axis=1))) <= {rendered.instances.index("gripper"), knob}
            for place in (rendered.instances.index("gripper"), knob):
                x, y, width, height = boxes[place].astype(int)
                inside = ids[y : y + height, x : x + width] == place
                assert inside.sum() == (ids == place).sum() > 0
                edges = (inside[0], inside[-1], inside[:, 0], inside[:, -1])
                assert all(edge.any() for edge in edges), "no smaller box has all of them"


def test_streams_that_differ_in_colours_share_their_geometry(rendered: Rendered) -> None:
    ids = {name: stream.geometry.stream_id for name, stream in STREAMS.items()}
    assert ids["dim"] == ids["moved"]
    assert set(rendered.geometry) == set(ids.values())
    assert ids["image"] == STREAMS["image"].stream_id


def test_extras_change_no_frame_and_need_asking_for(rendered: Rendered, middle: Trajectory, opened: LastScene) -> None:
    plain = render(middle, STOVE, list(STREAMS.values()), RenderConfig(), opened)
    assert plain.streams == rendered.streams
    assert (plain.object_poses, plain.instances) == (None, ())
    for name, geometry in plain.geometry.items():
        assert geometry.maps == {}
        np.testing.assert_array_equal(geometry.extrinsics, rendered.geometry[name].extrinsics)


def test_maps_show_no_site_that_is_hidden(middle: Trajectory) -> None:
    """robosuite hides the rod along the gripper's axis by a negative opacity; at 0 MuJoCo leaves a site out."""
    renderer = Renderer(middle.model_xml)
    assert (middle.site_alpha[0] < 0).any()
    for view in SCHEMA.views.values():
        shown = []
        for site_alpha in (middle.site_alpha[0], middle.site_alpha[0].clip(0)):
            renderer.restore(middle.states[0], site_alpha)
            shown.append(renderer.surfaces(view.camera))
        for mine, right in zip(*shown, strict=True):
            np.testing.assert_array_equal(mine, right)
    renderer.close()


def test_depth_is_mujocos_own(middle: Trajectory) -> None:
    renderer = Renderer(middle.model_xml)
    renderer.restore(middle.states[0], middle.site_alpha[0].clip(0))
    option = mujoco.MjvOption()
    option.geomgroup[0] = 0
    for view in SCHEMA.views.values():
        mine = renderer.surfaces(view.camera).depth_m
        with mujoco.Renderer(renderer.model, *mine.shape) as theirs:
            theirs.enable_depth_rendering()
            theirs.update_scene(renderer.data, view.camera, option)
            assert np.abs(theirs.render()[::-1] - mine).max() < SCHEMA.depth.unit_m / 2
    renderer.close()


@pytest.fixture(scope="module")
def run(short_demos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of a run with all extras: a clean episode, one with a moved camera, one with added objects."""
    fields = tiny_config(short_demos)
    fields["demos"] = {"source": "hdf5", "root": str(short_demos), "tasks": [f"{BOWL.suite}/{BOWL.name}"]}
    fields["plan"] = {
        "seed": 7,
        "axes": {"camera": {}, "layout": {"levels": [2]}},
        "episodes": {"camera": 1, "layout": 1},
        "reserve": 3.0,
    }
    fields["render"] = {"extras": EXTRAS}
    config, data = Config.model_validate(fields), tmp_path_factory.mktemp("run")
    rows = plan.make(config.demos.index().entries, config.plan, config.replay, TestSet(()))
    plan.write(rows, data / "plan.parquet")
    judged = Replays(config.demos, config.replay, TrajectoryStore(data / "trajectories"), loop).complete(rows)
    render_plan(rows, config, TrajectoryStore(data / "trajectories"), FrameStore(data / "frames", config.render), loop)
    outcome = selection.select(rows, judged)
    kept = [row for row in rows if outcome[row.episode_id].kept]
    load = EpisodeLoader(data, config.render)
    known = {
        row.episode_id: EpisodeFacts(row.suite, "", row.demo_id, row.instruction, len(load(row.episode_id)))
        for row in kept
    }
    for target in config.export.datasets(data, config.render.content):
        export(target, Episodes(known, load), loop)
    (data / "config.json").write_text(config.model_dump_json())
    return data


def cases(data: Path) -> list[Case]:
    """Every episode, as the store and both datasets have it."""
    config = Config.model_validate_json((data / "config.json").read_text())
    load = EpisodeLoader(data, config.render)
    rows = {row.episode_id: vars(row) for row in plan.read(data / "plan.parquet")}
    formats = config.export.datasets(data, config.render.content)
    places: dict[str, dict[str, Any]] = {}
    for one in formats:
        for episode_id, place in one.record().places.items():
            places.setdefault(episode_id, dict(rows[episode_id])).update(place)
    read = {episode_id: [one.read(row) for one in formats] for episode_id, row in places.items()}
    return [
        Case(
            row=row,
            episode=load(episode_id),
            trajectory=TrajectoryStore(data / "trajectories").load(row["trajectory_id"]),
            copies=[copy for copy in read[episode_id] if copy is not None],
            bank=None,
        )
        for episode_id, row in places.items()
    ]


def test_both_datasets_have_what_the_store_has(run: Path) -> None:
    found = cases(run)
    assert sorted(str(case.row["axis"]) for case in found) == ["camera", "clean", "layout"]
    names = {str(case.row["axis"]): tuple(case.episode.instances) for case in found}
    assert names["clean"] == names["camera"] == (*COMMON, *bddl.read(BOWL.bddl_file).things)
    assert names["layout"][: len(names["clean"])] == names["clean"], "an id means the same in all episodes of a task"
    assert len(names["layout"]) == len(names["clean"]) + 2
    for case in found:
        assert [copy.dataset for copy in case.copies] == ["rlds", "lerobot"]
        assert list(CHECKS["geometry"].find(case)) == []
        assert list(CHECKS["boxes"].find(case)) == []
        assert CHECKS["boxes"].applies(case)
        last = pixels(case.episode.geometry["image"].maps["segmentation"][-1])
        shown = {case.episode.instances[place] for place in np.unique(last).tolist()}
        assert {"robot", "gripper", "table", "wall", "plate_1", "wooden_cabinet_1"} <= shown
    moved, clean = (
        next(case.episode.geometry for case in found if case.row["axis"] == axis) for axis in ("camera", "clean")
    )
    assert not np.array_equal(moved["image"].extrinsics, clean["image"].extrinsics)
    assert moved["wrist_image"].maps == clean["wrist_image"].maps


def test_the_traces_go_through_the_pixels_of_the_gripper(run: Path) -> None:
    """By the boxes around its mask, which the renderer's ids give."""
    compared = 0
    for case in cases(run):
        boxes = case.episode.geometry["image"].boxes
        assert boxes is not None
        for note in event_annotations(case.episode, 256):
            for k, (x, y) in enumerate(json.loads(note.text)["points"]):
                left, top, width, height = boxes[note.step + k * TRACE_STEPS, case.episode.instances.index("gripper")]
                assert (left <= x < left + width, top <= y < top + height) == (True, True)
                compared += 1
    assert compared > 5


def test_a_changed_matrix_file_or_pose_is_a_finding(run: Path) -> None:
    case = cases(run)[0]
    (copy, *_) = case.copies
    made = copy.episode
    seen = made.geometry["image"]
    assert made.object_poses is not None
    assert seen.boxes is not None
    for spoilt, what in (
        (replace(made, geometry={**made.geometry, "image": replace(seen, extrinsics=seen.extrinsics.T)}), "image_ext"),
        (replace(made, geometry={**made.geometry, "image": made.geometry["wrist_image"]}), "image_"),
        (replace(made, object_poses=made.object_poses[::-1]), "object_poses"),
        (replace(made, geometry={**made.geometry, "image": replace(seen, boxes=seen.boxes + 1)}), "image_boxes"),
        (replace(made, instances=made.instances[:-1]), "instances"),
    ):
        findings = list(CHECKS["geometry"].find(replace(case, copies=[replace(copy, episode=spoilt)])))
        assert findings
        assert {finding.what.startswith(what) for finding in findings} == {True}


@pytest.mark.parametrize("view", ["image", "wrist_image"])
def test_a_box_that_is_not_around_its_mask_is_a_finding(view: str, run: Path) -> None:
    case = cases(run)[0]
    seen = case.episode.geometry[view]
    assert seen.boxes is not None
    shifted = seen.boxes.copy()
    place = case.episode.instances.index("gripper")
    shifted[0, place, 0] += 1
    spoilt = replace(case.episode, geometry={**case.episode.geometry, view: replace(seen, boxes=shifted)})
    (finding,) = CHECKS["boxes"].find(replace(case, episode=spoilt))
    assert finding.what.startswith(f"{view}_boxes of step 0 has ")
    assert finding.what.endswith(f"at place {place}")


def test_the_example_runs_on_it(run: Path) -> None:
    command = [sys.executable, str(REPOSITORY / "examples" / "back_project.py"), str(run)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for view in ("image", "wrist_image"):
        assert any(line.startswith(f"libero_tiny_goal {view}: akita_black_bowl_1 on ") for line in lines)
