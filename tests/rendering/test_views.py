"""Frames of every size and of LIBERO's further cameras, from the renderer to the datasets."""

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import arenas
import mujoco
import numpy as np
import pytest
import yaml
from checkout import link_testset
from libero_environment import OffScreenRenderEnv
from numpy.typing import NDArray
from short_demonstrations import BOWL, STOVE
from short_runs import run_stages, tiny_config

from pipeline.config import Config, RenderConfig
from pipeline.episode_schema import ALL_VIEWS, SCHEMA, SIZE_PX
from pipeline.images.jpeg import decode
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.geometry import matrices
from pipeline.rendering.render import render
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.rendering.sight import Sight
from pipeline.run.run import Run
from pipeline.types import Frame, Jpeg, Task, Trajectory

CAMERAS = [view.camera for view in ALL_VIEWS.values()]
SIZES_PX = (64, 130, 512)
"""Smallest size, a size that is no multiple of 4, and the largest size, which is above MuJoCo's default buffer."""

STAGES = (
    "inputs",
    "plan",
    "leakage",
    "replay",
    "render",
    "exports",
    "manifest",
    "validate",
    "recipe",
    "summary",
    "card",
)


@pytest.mark.slow
@pytest.mark.parametrize("size_px", SIZES_PX)
def test_frames_of_every_size_are_those_of_mujocos_renderer(size_px: int) -> None:
    """``mujoco.Renderer`` has the first row at the top; ``test_arenas.py`` compares 256 pixels in each arena."""
    model_xml, state = arenas.scene("tabletop")
    option = mujoco.MjvOption()
    option.geomgroup[0] = 0
    ours: dict[str, Frame] = {}
    with closing(Renderer(model_xml, size_px=size_px)) as renderer:
        renderer.restore(state, renderer.site_alpha)
        for camera in CAMERAS:
            ours[camera] = renderer.frame(camera)
        model, data = renderer.model, renderer.data
    model.vis.global_.offheight = max(model.vis.global_.offheight, size_px)
    with mujoco.Renderer(model, size_px, size_px, max_geom=1000) as theirs:
        for camera in CAMERAS:
            theirs.update_scene(data, camera, option)
            assert np.array_equal(ours[camera], theirs.render()[::-1]), camera


@pytest.fixture(scope="module")
def libero(whole: dict[Task, Trajectory]) -> Iterator[OffScreenRenderEnv]:
    env = OffScreenRenderEnv(
        bddl_file_name=str(STOVE.bddl_file), camera_names=CAMERAS, camera_heights=128, camera_widths=128
    )
    env.reset_from_xml_string(whole[STOVE].model_xml)
    yield env
    env.close()


def test_frames_equal_liberos_environment(
    libero: OffScreenRenderEnv, whole: dict[Task, Trajectory], opened: LastScene
) -> None:
    trajectory = whole[STOVE]
    renderer = opened.renderer(trajectory.model_xml, 128)
    for step in (0, len(trajectory.actions) // 2):
        renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
        ours = {camera: renderer.frame(camera) for camera in CAMERAS}
        libero.sim._render_context_offscreen.gl_ctx.make_current()
        theirs = libero.set_init_state(trajectory.states[step])
        for camera in CAMERAS:
            assert np.array_equal(ours[camera], theirs[f"{camera}_image"]), f"{camera} at step {step}"


class Measured(NamedTuple):
    """Measures of a scene in frames of one size: shape of a frame, matrices of each view, and pixels of each thing."""

    shape: tuple[int, ...]
    matrices: dict[str, tuple[NDArray[Any], NDArray[Any]]]
    things_px: Mapping[str, int]


def measured(opened: LastScene, trajectory: Trajectory, size_px: int) -> Measured:
    """Measure a trajectory's first state; a renderer of another size opens the scene again."""
    renderer = opened.renderer(trajectory.model_xml, size_px)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    assert renderer.surfaces("birdview").depth_m.shape == (size_px, size_px)
    return Measured(
        renderer.frame("agentview").shape,
        {view: matrices(renderer, view) for view in ALL_VIEWS},
        Sight.of(renderer, STOVE, trajectory.states[:1, 1:4]).things_px,
    )


@pytest.fixture(scope="module")
def by_size_px(whole: dict[Task, Trajectory], opened: LastScene) -> dict[int, Measured]:
    return {size_px: measured(opened, whole[STOVE], size_px) for size_px in (128, 256, 512)}


def test_one_scene_is_opened_in_several_sizes(
    by_size_px: dict[int, Measured], whole: dict[Task, Trajectory], opened: LastScene
) -> None:
    again = measured(opened, whole[STOVE], 128)
    shapes = [found.shape for found in (*by_size_px.values(), again)]
    assert shapes == [(128, 128, 3), (256, 256, 3), (512, 512, 3), (128, 128, 3)]


def test_matrices_scale_with_the_size(by_size_px: dict[int, Measured]) -> None:
    """A point at (u + 0.5) of 256 pixels is at (u + 0.5) / 2 of 128 pixels: pixel centres have whole numbers."""
    for view in ALL_VIEWS:
        small_intrinsics, small_extrinsics = by_size_px[128].matrices[view]
        intrinsics, extrinsics = by_size_px[256].matrices[view]
        halved = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]]) @ intrinsics
        np.testing.assert_allclose(small_intrinsics, halved, rtol=1e-6)
        np.testing.assert_array_equal(small_extrinsics, extrinsics)


def test_things_count_as_many_pixels_in_every_size(by_size_px: dict[int, Measured]) -> None:
    for thing, expected_px in by_size_px[256].things_px.items():
        assert expected_px > 100, "otherwise this test tells little"
        for size_px in (128, 512):
            counted_px = by_size_px[size_px].things_px[thing]
            assert counted_px == pytest.approx(expected_px, rel=0.1), f"{thing} in {size_px} px"


def test_a_missing_camera_is_a_reason(whole: dict[Task, Trajectory], opened: LastScene) -> None:
    source = whole[STOVE]
    model_xml = source.model_xml.replace('name="birdview"', 'name="another"')
    assert model_xml != source.model_xml
    scene = source.scene.__class__(**{**vars(source.scene), "model_xml": model_xml})
    short = Trajectory(**{**vars(source), "scene": scene, "states": source.states[:3], "actions": source.actions[:2]})
    streams = [Stream("image", ()), Stream("bird_image", ())]
    rendered = render(short, STOVE, streams, RenderConfig(views=("birdview",)), opened)
    assert rendered.rejected == {streams[1].stream_id: "camera_missing"}
    assert set(rendered.streams) == {streams[0].stream_id}


def test_each_axis_leaves_or_changes_a_further_view() -> None:
    views = RenderConfig(views=("sideview", "frontview")).content.views
    assert views == ("image", "wrist_image", "front_image", "side_image")
    camera = '{"axis":"camera","component":"spherical","level":3,"azimuth_deg":30.0}'
    light = '{"axis":"light","component":"diffuse","level":1,"diffuse_scale_rgb":[0.9,0.9,0.9]}'
    clean, moved, dim = (streams_of(changes, views) for changes in ("[]", f"[{camera}]", f"[{light}]"))
    assert {view for view in views if moved[view] != clean[view]} == {"image"}
    assert {view for view in views if dim[view] != clean[view]} == set(views)


@pytest.mark.parametrize(
    ("field", "value"), [("size_px", 62), ("size_px", 255), ("size_px", 514), ("views", ["agentview"])]
)
def test_other_sizes_and_cameras_are_rejected(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        RenderConfig.model_validate({field: value})


def test_defaults_are_no_part_of_what_finished_work_was_made_from() -> None:
    stated = RenderConfig().model_dump()
    assert not stated.keys() & {"size_px", "views"}
    assert RenderConfig(size_px=SIZE_PX, views=()).model_dump() == stated
    assert RenderConfig().content.stated() == [()]


@pytest.mark.slow
def test_a_run_of_small_frames_with_a_further_view(short_demos: Path, tmp_path: Path) -> None:
    """Add a view to a finished run: its other frames stay as they are, and every check of ``validate`` passes."""
    config = tiny_config(short_demos)
    config["demos"]["tasks"] = [f"{BOWL.suite}/{BOWL.name}"]
    config["plan"]["episodes"] = {"camera": 1, "noise": 1, "light": 1}
    config["plan"]["axes"] = {"camera": {}, "noise": {}, "light": {}}
    config["render"] = {"size_px": 96, "extras": ["depth", "segmentation"]}
    config["export"]["lerobot_v21"] = {"name": "tiny", "convention": "ipec"}
    config["export"]["lerobot_openpi"] = {"name": "tiny"}
    link_testset(tmp_path)
    run_stages(tmp_path, config, STAGES[:5])
    former = frames_of(tmp_path, config)
    config["render"]["views"] = ["frontview"]
    run_stages(tmp_path, config, STAGES)
    latter = frames_of(tmp_path, config)
    assert len(former) == 4
    for episode_id, views in former.items():
        assert {*latter[episode_id]} == {*SCHEMA.views, "front_image"}
        for view, files in views.items():
            assert latter[episode_id][view] == files
            assert decode(files[0]).shape == (96, 96, 3)
    readme = (tmp_path / "data" / "tiny" / "card" / "lerobot" / "README.md").read_text()
    assert "96x96 RGB" in readme
    recipe = yaml.safe_load((tmp_path / "data" / "tiny" / "finetune" / "finetune.yaml").read_text())
    command = recipe["clients"]["lerobot_act"]["command"]
    assert '"observation.images.image2": {"type": "VISUAL", "shape": [3, 96, 96]}' in command
    assert "images.front" not in command, "an evaluation has no front view"
    assert "`observation.images.front` from the camera frontview" in readme


def frames_of(folder: Path, config: dict[str, object]) -> dict[str, dict[str, list[Jpeg]]]:
    """Return the stored frames of every kept episode by view."""
    opened = Run(Config.model_validate({**config, "folder": folder / "data"}))
    load, stored = opened.episode_loader(), {}
    for episode_id in opened.outcome.kept:
        stored[episode_id] = {view: list(files) for view, files in load(episode_id).frames.items()}
    return stored
