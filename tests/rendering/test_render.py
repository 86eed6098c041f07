"""Rendering: pixel for pixel what LIBERO's own environment returns, and no more of the model changed than is said."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from checkout import REPOSITORY
from libero_environment import OffScreenRenderEnv, transform
from short_demonstrations import MILK, STOVE

from pipeline import axes
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.light import LightPerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.images.jpeg import decode, encode, to_policy
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.render import render
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.rendering.sight import LEAST_PX, MOST_OUTSIDE, Sight
from pipeline.scenes.compiled import proprioception
from pipeline.seeding import rng
from pipeline.stores.frame_store import FrameStore
from pipeline.types import Frame, Task, Trajectory

sys.path.append(str(REPOSITORY / "examples"))

from add_axis import LensPerturbation

MOVED = CameraPerturbation(component="spherical", level=3, azimuth_deg=30.0, elevation_deg=8.0)


class Libero:
    """LIBERO's environment as an evaluation uses it, in a recorded scene."""

    def __init__(self, task: Task, model_xml: str):
        self.env = OffScreenRenderEnv(bddl_file_name=str(task.bddl_file), camera_heights=256, camera_widths=256)
        self.env.reset_from_xml_string(model_xml)

    def observe(self, state: np.ndarray) -> dict[str, np.ndarray]:  # type: ignore[type-arg]
        # robosuite makes its context current when it is created and relies on being alone in the process.
        self.env.sim._render_context_offscreen.gl_ctx.make_current()
        observation: dict[str, np.ndarray] = self.env.set_init_state(state)  # type: ignore[type-arg]
        return observation


@pytest.fixture(scope="module", params=[STOVE, MILK], ids=lambda task: task.name)
def libero_frames(request: pytest.FixtureRequest, whole: dict[Task, Trajectory]) -> Iterator[tuple[Trajectory, Libero]]:
    trajectory = whole[request.param]
    libero = Libero(request.param, trajectory.model_xml)
    yield trajectory, libero
    libero.env.close()


@pytest.mark.parametrize("perturbed", [False, True], ids=["clean", "camera moved"])
def test_frames_and_proprioception_equal_libero(
    libero_frames: tuple[Trajectory, Libero], opened: LastScene, perturbed: bool
) -> None:
    trajectory, libero = libero_frames
    ours: dict[int, tuple[dict[str, Frame], np.ndarray, np.ndarray]] = {}  # type: ignore[type-arg]
    steps = (0, len(trajectory.actions) // 2, len(trajectory.actions))
    renderer = opened.renderer(trajectory.model_xml)
    with renderer.perturbed([MOVED] if perturbed else []):
        for step in steps:
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            frames = {view: renderer.frame(spec.camera) for view, spec in SCHEMA.views.items()}
            ours[step] = frames, *proprioception(renderer.data)

    model = libero.env.sim.model._model
    saved = {name: getattr(model, name).copy() for name in MOVED.fields}
    if perturbed:
        MOVED.apply(model)
    for step in steps:
        theirs = libero.observe(trajectory.states[step])
        frames, state, joint_state = ours[step]
        for view, spec in SCHEMA.views.items():
            assert np.array_equal(frames[view], theirs[f"{spec.camera}_image"]), f"{view} at step {step}"
        # The state that OpenVLA's data and evaluation build from LIBERO's observations.
        quat_xyzw = theirs["robot0_eef_quat"].copy()
        expected = [theirs["robot0_eef_pos"], transform.quat2axisangle(quat_xyzw), theirs["robot0_gripper_qpos"]]
        assert np.array_equal(state, np.concatenate(expected).astype(np.float32))
        sine_cosine = np.concatenate([np.sin(joint_state), np.cos(joint_state)])
        observed = np.concatenate([theirs["robot0_joint_pos_sin"], theirs["robot0_joint_pos_cos"]])
        assert np.allclose(sine_cosine, observed, atol=1e-6)
    for name, value in saved.items():
        getattr(model, name)[:] = value


def test_lit_burner_is_seen(whole: dict[Task, Trajectory], opened: LastScene) -> None:
    trajectory = whole[STOVE]
    renderer = opened.renderer(trajectory.model_xml)
    last = trajectory.states[-1]
    renderer.restore(last, trajectory.site_alpha[-1])
    lit = renderer.frame("agentview").astype(int)
    renderer.restore(last, trajectory.site_alpha[0])
    dark = renderer.frame("agentview").astype(int)
    assert np.abs(lit - dark).max() > 50


def fields(model: mujoco.MjModel) -> dict[str, bytes]:
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: value.tobytes() for name, value in arrays.items() if isinstance(value, np.ndarray)}


def test_camera_changes_the_camera_alone_and_is_undone(whole: dict[Task, Trajectory], opened: LastScene) -> None:
    trajectory = whole[MILK]
    renderer = opened.renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    before, wrist = fields(renderer.model), renderer.frame("robot0_eye_in_hand")
    agent = renderer.frame("agentview")
    with renderer.perturbed([MOVED]):
        renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
        during = fields(renderer.model)
        assert {name for name in before if before[name] != during[name]} == {"cam_pos", "cam_quat"}
        assert np.array_equal(renderer.frame("robot0_eye_in_hand"), wrist)
        assert not np.array_equal(renderer.frame("agentview"), agent)
    assert fields(renderer.model) == before


def test_streams_are_shared_where_nothing_shows() -> None:
    clean = streams_of("[]")
    noise = NoiseAxis().sample(rng("test"), MILK, 0)
    moved = streams_of(f"[{MOVED.model_dump_json()}]")
    noisy = streams_of(f"[{noise.model_dump_json()}]")
    for changed in (moved, noisy):
        assert changed["wrist_image"].stream_id == clean["wrist_image"].stream_id
        assert changed["image"].stream_id != clean["image"].stream_id


def test_render_layers_in_order(whole: dict[Task, Trajectory], short_demos: Path, opened: LastScene) -> None:
    """Noise is laid on the clean frame of its own camera, in the simulator's orientation, then the frame is turned."""
    del short_demos
    source = whole[MILK]
    steps = 8
    trajectory = Trajectory("t", "open_loop", source.scene, source.states[: steps + 1], source.actions[:steps],
                            source.site_alpha[: steps + 1], source.verdict)  # fmt: skip
    noise = NoiseAxis().sample(rng("order"), MILK, 0)
    streams = [
        Stream("image", ()),
        Stream("image", (MOVED,)),
        Stream("image", (MOVED, noise)),
        Stream("wrist_image", ()),
    ]
    config = RenderConfig()
    rendered = render(trajectory, MILK, streams, config, opened)
    assert set(rendered.streams) == {stream.stream_id for stream in streams}
    assert rendered.state.shape == (steps, 8)
    assert rendered.joint_state.shape == (steps, 7)
    renderer = Renderer(trajectory.model_xml)
    with renderer.perturbed([MOVED]):
        renderer.restore(trajectory.states[5], trajectory.site_alpha[5])
        raw = renderer.frame("agentview")
    renderer.close()
    assert rendered.streams[streams[1].stream_id][5] == encode(to_policy(raw), config.jpeg_quality)
    assert rendered.streams[streams[2].stream_id][5] == encode(to_policy(noise.apply(raw, 5)), config.jpeg_quality)
    assert np.abs(decode(rendered.streams[streams[1].stream_id][5]).astype(int) - raw[::-1, ::-1]).mean() < 3


def test_turned_by_half_a_turn() -> None:
    frame = rng("turn").integers(0, 256, (256, 256, 3), np.uint8)
    assert SCHEMA.image_rotation_deg == 180
    assert np.array_equal(to_policy(frame), np.rot90(frame, 2))


def test_a_black_frame_is_rejected_with_its_reason_and_remembered(
    whole: dict[Task, Trajectory], tmp_path: Path, opened: LastScene
) -> None:
    source = whole[MILK]
    trajectory = replace(source, states=source.states[:9], actions=source.actions[:8])
    night = LightPerturbation(component="diffuse", level=5, diffuse_scale_rgb=(0.0, 0.0, 0.0))
    streams = [Stream("image", ()), Stream("image", (night,)), Stream("image", (MOVED,))]
    # LIBERO's head light keeps frames from being black, so put it out as no perturbation can.
    dark = '<visual><headlight diffuse="0 0 0" ambient="0 0 0" specular="0 0 0"/></visual>'
    unlit = trajectory.model_xml.replace("<worldbody>", f"{dark}<worldbody>", 1)
    rendered = render(
        replace(trajectory, scene=replace(source.scene, model_xml=unlit)), MILK, streams, RenderConfig(), opened
    )
    assert rendered.rejected == {streams[1].stream_id: "too_dark"}
    assert set(rendered.streams) == {streams[0].stream_id, streams[2].stream_id}
    store = FrameStore(tmp_path, RenderConfig())
    store.save("0" * 16, rendered, "some device")
    (row,) = store.rows().values()
    assert {*row["streams"], *json.loads(row["rejected"])} == {stream.stream_id for stream in streams}
    assert json.loads(row["rejected"]) == rendered.rejected


def test_geoms_are_those_that_pixels_show(whole: dict[Task, Trajectory], opened: LastScene) -> None:
    trajectory = whole[MILK]
    renderer = opened.renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    before = renderer.frame("agentview")
    seen = renderer.geoms("agentview")
    assert np.array_equal(renderer.frame("agentview"), before), "looking for geoms changes later frames"
    milk = renderer.model.geom_bodyid == renderer.model.body("milk_1_main").id
    groups = renderer.model.geom_group[milk]
    renderer.model.geom_group[milk] = 5  # not shown
    gone = (np.abs(renderer.frame("agentview").astype(int) - before) > 5).any(axis=2)
    renderer.model.geom_group[milk] = groups
    shown = milk[seen] & (seen >= 0)
    assert shown.sum() > 100
    assert (gone & shown).sum() > 0.9 * shown.sum()
    assert (gone & ~shown).sum() < 0.1 * shown.sum()


def test_a_camera_that_loses_sight_of_the_task_is_rejected_with_its_reason(
    whole: dict[Task, Trajectory], opened: LastScene
) -> None:
    source = whole[MILK]
    trajectory = replace(source, states=source.states[:9], actions=source.actions[:8])
    cameras = {
        "seen": MOVED,
        # The basket leaves the frame at its side; then the hand at its top.
        "task_object_not_seen": CameraPerturbation(component="orientation", level=5, yaw_deg=18.0),
        "hand_not_seen": CameraPerturbation(component="orientation", level=5, pitch_deg=16.0),
    }
    streams = {name: Stream("image", (camera,)) for name, camera in cameras.items()}
    rendered = render(trajectory, MILK, list(streams.values()), RenderConfig(), opened)
    assert rendered.rejected == {streams[name].stream_id: name for name in cameras if name != "seen"}
    assert set(rendered.streams) == {streams["seen"].stream_id}


def test_a_lens_that_loses_sight_of_the_task_is_rejected_too(
    whole: dict[Task, Trajectory], opened: LastScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As a change of pipeline/axes/__init__.py would have it.
    monkeypatch.setitem(axes._PLACE, "lens", 0)
    trajectory = replace(whole[MILK], states=whole[MILK].states[:3], actions=whole[MILK].actions[:2])
    lenses = [LensPerturbation(component="zoom", level=5, fovy_scale=scale) for scale in (0.3, 0.97)]
    lost, seen = (Stream("image", (lens,)) for lens in lenses)
    rendered = render(trajectory, MILK, [lost, seen], RenderConfig(), opened)
    assert rendered.rejected == {lost.stream_id: "task_object_not_seen"}
    assert set(rendered.streams) == {seen.stream_id}


def test_what_the_original_does_not_show_either_is_no_reason() -> None:
    seen = Sight({"milk_1": 300, "basket_1": 900}, 0.0)
    assert Sight({"milk_1": LEAST_PX, "basket_1": 900}, MOST_OUTSIDE).faults(seen) == []
    assert Sight({"milk_1": LEAST_PX - 1, "basket_1": 900}, 0.0).faults(seen) == ["task_object_not_seen"]
    assert Sight({"milk_1": 300, "basket_1": 900}, MOST_OUTSIDE + 0.01).faults(seen) == ["hand_not_seen"]
    hidden = Sight({"milk_1": 5, "basket_1": 900}, 0.5)
    assert Sight({"milk_1": 5, "basket_1": 900}, 0.5).faults(hidden) == []
    assert Sight({"milk_1": 4, "basket_1": 900}, 0.6).faults(hidden) == ["task_object_not_seen", "hand_not_seen"]


def test_the_hand_is_outside_where_its_place_is_not_in_the_frame(
    whole: dict[Task, Trajectory], opened: LastScene
) -> None:
    trajectory = whole[MILK]
    renderer = opened.renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    seen = renderer.geoms("agentview")
    bodies = set(renderer.model.geom_bodyid[seen[seen >= 0]].tolist())
    within_m = [renderer.data.body(name).xpos for name in ("milk_1_main", "basket_1_main")]
    assert {renderer.model.body(name).id for name in ("milk_1_main", "basket_1_main")} <= bodies, "these are seen"
    camera = renderer.data.camera("agentview")
    ahead_m = -camera.xmat.reshape(3, 3)[:, 2]
    outside_m = [within_m[0] + [0.0, 2.0, 0.0], within_m[0] - [0.0, 2.0, 0.0], camera.xpos - ahead_m]
    assert Sight.of(renderer, MILK, np.array([*within_m, camera.xpos + ahead_m])).hand_outside == 0.0
    assert Sight.of(renderer, MILK, np.array(outside_m)).hand_outside == 1.0
    assert Sight.of(renderer, MILK, np.array([*within_m, *outside_m])).hand_outside == 3 / 5
