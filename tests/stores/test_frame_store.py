"""A plan has the frames of a first run whatever was there before, and finished work is not made again unasked."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bowl import bowl_config, bowl_plan, given_up, nothing_to_do, replay_bowl
from conftest import Once

from pipeline import gl, identity
from pipeline.axes.light import LightPerturbation
from pipeline.compute.pool import Workers, loop
from pipeline.config import Config
from pipeline.episode_schema import STANDARD
from pipeline.errors import PipelineError
from pipeline.planning import plan
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.render import render
from pipeline.rendering.renderer import LastScene
from pipeline.run.outcome import join_kinds, outdated
from pipeline.run.progress import rejections
from pipeline.run.render_job import RenderJob
from pipeline.run.render_stage import STREAMS_OF_A_JOB, portions, render_plan
from pipeline.stores.frame_store import FrameStore, frames_by_trajectory
from pipeline.stores.trajectory_store import TrajectoryStore


def render_into(folder: Path, rows: Sequence[plan.Row], config: Config, replayed: Path, workers: Workers) -> set[str]:
    """Render the frames of a plan into a folder, from replayed trajectories."""
    return render_plan(rows, config, TrajectoryStore(replayed), FrameStore(folder, config.render), workers)


@pytest.fixture(scope="module")
def config(short_demos: Path) -> Config:
    return bowl_config(short_demos)


@pytest.fixture(scope="module")
def rows(config: Config) -> list[plan.Row]:
    return bowl_plan(config)


@pytest.fixture(scope="module")
def whole_replay(config: Config, once: Once) -> Path:
    return once("bowl", partial(replay_bowl, config))


@pytest.fixture(scope="module")
def replayed(whole_replay: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without what follows the first three steps: most tests render it."""
    whole, store = TrajectoryStore(whole_replay), TrajectoryStore(tmp_path_factory.mktemp("replayed"))
    (name,) = whole.names()
    one = whole.load(name)
    store.save(replace(one, states=one.states[:4], actions=one.actions[:3], site_alpha=one.site_alpha[:4]))
    store.keep([name])
    return store.root


@pytest.fixture(scope="module", autouse=True)
def one_scene(opened: LastScene) -> Iterator[None]:
    """All tests render the same scene, which stays open from one to the next."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.run.render_job.scene_of_process", lambda: opened)
        yield


@pytest.fixture
def next_recipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[identity.Step], None]]:
    """Raises the recipe number of a step, until the test is over."""

    def raised(step: identity.Step) -> None:
        identity._parts.cache_clear()
        monkeypatch.setitem(identity.RECIPES, step, identity.RECIPES[step] + 1)

    yield raised
    identity._parts.cache_clear()


@pytest.mark.parametrize("step", ["physics", "pixels"])
def test_finished_work_is_generated_again_only_where_that_was_allowed(
    step: identity.Step,
    config: Config,
    rows: list[plan.Row],
    replayed: Path,
    next_recipe: Callable[[identity.Step], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv(identity.REMAKE, raising=False)
    stored = TrajectoryStore(shutil.copytree(replayed, tmp_path / "trajectories"))
    store = FrameStore(tmp_path / "frames", config.render)
    store.keep(render_into(tmp_path / "frames", rows, config, replayed, loop))
    assert not outdated(rows, stored, store, gl.choose().device)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}

    next_recipe(step)
    number = f"recipe of {step} {identity.RECIPES[step] - 1}, here {identity.RECIPES[step]}"
    found = outdated(rows, TrajectoryStore(stored.root), FrameStore(store.root, config.render))
    told = {"files of frames": {number: 1}}
    assert found == told | ({"trajectories": {number: 1}} if step == "physics" else {})
    with pytest.raises(PipelineError, match=rf"1 files of frames, generated with {number}(?s:.*)REMAKE=1` before"):
        identity.require_remake_permission(join_kinds(found), tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before
    monkeypatch.setenv(identity.REMAKE, "1")
    identity.require_remake_permission(join_kinds(found), tmp_path)
    assert number in capsys.readouterr().out
    if step == "pixels":
        monkeypatch.delenv(identity.REMAKE)
        again = FrameStore(tmp_path / "frames", config.render)
        again.keep(render_into(tmp_path / "frames", rows, config, replayed, loop))
        assert not outdated(rows, stored, again, gl.choose().device), "a remake is asked for once"
        assert again.settings_by_fingerprint().keys() == {again.fingerprint}


def test_what_the_user_changed_is_made_without_a_question(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    stored = TrajectoryStore(shutil.copytree(replayed, tmp_path / "trajectories"))
    store = FrameStore(tmp_path / "frames", config.render)
    store.keep(render_into(tmp_path / "frames", rows, config, replayed, loop))
    other = config.model_copy(update={"render": config.render.model_copy(update={"jpeg_quality": 80})})
    changed = FrameStore(tmp_path / "frames", other.render)
    assert not changed.rows()
    assert not outdated(rows, stored, changed, gl.choose().device)
    device = outdated(rows, stored, store, "another device")
    assert device == {"files of frames": {f"OpenGL device {gl.choose().device}, here another device": 1}}
    assert not outdated([], stored, store), "a file that no episode of today's plan needs"


def without_twins(rows: Sequence[plan.Row]) -> list[plan.Row]:
    return [row for row in rows if row.role != "twin"]


def test_rendering_ends_when_all_streams_of_a_trajectory_are_rejected(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every frame under a changed light counts as too dark: LIBERO's head light prevents this otherwise."""
    monkeypatch.setattr("pipeline.rendering.sight.exposure", lambda frame: "too_dark")
    lights = without_twins(rows)
    assert len(lights) == 2
    passes: list[int] = []

    def counted(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
        passes.append(len(items))
        return loop(fn, items, description)

    render_into(tmp_path, lights, config, replayed, counted)
    stored = frames_by_trajectory(FrameStore(tmp_path, config.render).rows())
    (shown,) = stored.values()
    assert shown.streams == set()
    assert len(shown.rejected) == 4, "two views of the light episode and of its reserve"
    assert rejections(lights, stored, STANDARD.views) == dict.fromkeys((row.episode_id for row in lights), "too_dark")
    rendered = len(passes)
    render_into(tmp_path, lights, config, replayed, counted)
    assert len(passes) == rendered, "a second run has nothing to do"


def test_frames_are_the_same_in_one_file_and_in_several(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a trajectory has more streams than a job renders."""
    render_into(tmp_path / "one", rows, config, replayed, loop)
    monkeypatch.setattr("pipeline.run.render_stage.STREAMS_OF_A_JOB", 1)
    files = render_into(tmp_path / "several", rows, config, replayed, loop)
    streams = {s.stream_id: s.geometry.stream_id for row in rows[:2] for s in streams_of(row.perturbations).values()}
    assert len(streams) == len(files) == 4
    one, several = (
        FrameStore(tmp_path / name, config.render).load(rows[0].trajectory_id, [*streams], {*streams.values()})
        for name in ("one", "several")
    )
    assert one.streams == several.streams
    assert one.geometry.keys() == several.geometry.keys() == set(streams.values())
    assert np.array_equal(one.state, several.state)


@pytest.mark.parametrize("streams_of_a_job", [2, 64])
def test_a_plan_that_grows_or_shrinks_has_the_files_of_a_first_run_and_renders_what_is_missing(
    config: Config,
    rows: list[plan.Row],
    replayed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    streams_of_a_job: int,
) -> None:
    monkeypatch.setattr("pipeline.run.render_stage.STREAMS_OF_A_JOB", streams_of_a_job)
    made: list[str] = []

    def noted(trajectory: Any, task: Any, streams: Sequence[Stream], render_config: Any, opened: Any) -> Any:
        made.extend(stream.stream_id for stream in streams)
        return render(trajectory, task, streams, render_config, opened)

    monkeypatch.setattr("pipeline.run.render_job.render", noted)

    def files(planned: Sequence[plan.Row], folder: str) -> dict[str, bytes]:
        store = FrameStore(tmp_path / folder, config.render)
        rendered = render_into(tmp_path / folder, planned, config, replayed, loop)
        (store.root / "0123.npz").write_bytes(b"all frames of a trajectory, as an earlier version stored them")
        store.keep(rendered)
        return {path.relative_to(store.root).as_posix(): path.read_bytes() for path in store.root.rglob("*.npz")}

    first = files(rows, "first"), files(rows[:1], "shorter")
    made.clear()
    files(rows[:1], "then")
    assert files(rows, "then") == first[0]
    assert len(made) == len(set(made)) == 4
    assert files(rows[:1], "then") == first[1]
    assert len(made) == 4


def test_a_rejection_that_is_no_longer_planned_is_forgotten(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    store, trajectory_id = FrameStore(tmp_path, config.render), rows[0].trajectory_id
    (name,) = render_into(tmp_path, rows[:1], config, replayed, loop)
    geometry = [stream.geometry.stream_id for stream in streams_of(rows[0].perturbations).values()]
    twin = store.load(trajectory_id, store.rows()[name]["streams"], geometry)
    store.path(name).unlink()
    store.save(trajectory_id, replace(twin, rejected={"earlier": "too_dark"}), gl.choose().device)
    store.keep(render_into(tmp_path, rows[:1], config, replayed, loop))
    (row,) = store.rows().values()
    assert json.loads(row["rejected"]) == {}
    assert row["streams"] == sorted(twin.streams)


def test_a_damaged_file_is_an_error_and_is_never_silently_rendered_again(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.run.render_stage.STREAMS_OF_A_JOB", 2)
    frames = tmp_path / "frames"
    files = render_into(frames, rows, config, replayed, loop)
    store = FrameStore(frames, config.render)
    whole, damaged = sorted(files)
    before = store.path(damaged).read_bytes()
    streams = store.rows()[whole]["streams"]
    store.path(damaged).write_bytes(before[:-100])
    assert store.load(rows[0].trajectory_id, streams).streams.keys() == set(streams), "it hinders no other file"
    wanted = {s.stream_id: s.geometry.stream_id for row in rows for s in streams_of(row.perturbations).values()}
    for read in (
        lambda: store.stored(rows[0].trajectory_id, wanted, gl.choose().device),
        lambda: render_into(frames, rows, config, replayed, nothing_to_do),
    ):
        with pytest.raises(
            PipelineError,
            match=rf"(?s){store.path(damaged).name}: the file is damaged \(.+\).*move the file to another place",
        ):
            read()
    assert store.path(damaged).read_bytes() == before[:-100]
    store.path(damaged).rename(tmp_path / "moved away")
    assert render_into(frames, rows, config, replayed, loop) == files
    assert store.path(damaged).read_bytes() == before


@pytest.mark.parametrize("number", [1, 64, 65, 600])
def test_a_job_has_so_many_streams_at_most(number: int) -> None:
    """And what is not needed changes its own portion alone."""
    night = LightPerturbation(component="diffuse", level=5, diffuse_scale_rgb=(0.0, 0.0, 0.0))
    lights = [night.model_copy(update={"diffuse_scale_rgb": (0.0, 0.0, step / number)}) for step in range(number)]
    streams = {stream.stream_id: stream for stream in (Stream("image", (light,)) for light in lights)}
    jobs = portions(streams, streams)
    assert len(jobs) == -(-number // STREAMS_OF_A_JOB)
    assert max(map(len, jobs)) <= STREAMS_OF_A_JOB
    assert sorted(stream.stream_id for job in jobs for stream in job) == sorted(streams)
    fewer = streams.keys() - {jobs[-1][0].stream_id}
    assert portions(streams, fewer) == [*jobs[:-1], *([jobs[-1][1:]] if jobs[-1][1:] else [])]


def test_rendering_that_leaves_the_same_work_undone_is_an_error(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    def elsewhere(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
        """Workers that write into a folder of their own."""
        return []

    with pytest.raises(PipelineError, match="still missing"):
        render_into(tmp_path, rows[:1], config, replayed, elsewhere)


def test_a_rendering_that_is_given_up_is_dropped_with_its_reason_and_keeps_what_was_there(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    render_into(tmp_path / "at_once", rows, config, replayed, given_up)
    stored = frames_by_trajectory(FrameStore(tmp_path / "at_once", config.render).rows())
    assert set(rejections(rows, stored, STANDARD.views).values()) == {"worker_lost"}
    render_into(tmp_path / "at_once", rows, config, replayed, nothing_to_do)

    twin, lights = rows[:1], without_twins(rows)
    render_into(tmp_path / "later", twin, config, replayed, loop)
    render_into(tmp_path / "later", rows, config, replayed, given_up)
    stored = frames_by_trajectory(FrameStore(tmp_path / "later", config.render).rows())
    assert rejections(rows, stored, STANDARD.views) == dict.fromkeys((row.episode_id for row in lights), "worker_lost")
    assert len(stored[twin[0].trajectory_id].streams) == 2, "the twin's own frames stay"


def test_states_are_those_of_the_replay_where_a_worker_was_lost_over_other_streams(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    """What is stored for a lost worker has no states, and is joined with what is rendered later."""
    twin = rows[0]
    streams = tuple(streams_of(twin.perturbations).values())
    job = RenderJob(twin, streams, replayed, tmp_path, config.render, gl.choose().device)
    replace(job, streams=streams[:1]).lost()
    job()
    made = FrameStore(tmp_path, config.render).load(twin.trajectory_id, [streams[1].stream_id])
    states = TrajectoryStore(replayed).load(twin.trajectory_id).states
    # Of a state: the time, then seven joints of the arm, then the fingers.
    np.testing.assert_array_equal(made.joint_state, states[:-1, 1:8].astype(np.float32))
    np.testing.assert_array_equal(made.state[:, 6:], states[:-1, 8:10].astype(np.float32))


def test_a_rejection_of_a_reserve_that_is_no_longer_needed_is_forgotten(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    """As when the rejected frames before it are deleted, to be tried again."""
    store = FrameStore(tmp_path, config.render)
    expected = render_into(tmp_path, rows, config, replayed, loop)
    store.keep(())
    render_plan(
        [replace(rows[2], wanted=True)],
        config,
        TrajectoryStore(replayed),
        FrameStore(tmp_path, config.render),
        given_up,
    )
    assert rejections(rows, frames_by_trajectory(store.rows()), STANDARD.views) == {rows[2].episode_id: "worker_lost"}
    assert render_into(tmp_path, rows, config, replayed, loop) == expected
