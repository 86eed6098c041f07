"""What is stored is current or missing, the table tells it without opening files, and nothing shrinks in silence."""

import errno
import json
import os
import resource
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import BOWL, limited, read_with_flipped_bits, tiny_config

from pipeline import gl, identity
from pipeline.axes import to_json
from pipeline.axes.light import LightPerturbation
from pipeline.axes.robot import RobotPerturbation
from pipeline.compute.pool import loop
from pipeline.config import Config, FilterConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.planning import plan, selection
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.render import render
from pipeline.rendering.renderer import LastScene
from pipeline.run import outcome
from pipeline.run.outcome import outdated
from pipeline.run.render_job import RenderJob
from pipeline.run.render_stage import STREAMS_OF_A_JOB, portions, render_plan
from pipeline.run.replay_stage import Replays
from pipeline.seeding import rng
from pipeline.stores.frame_store import FrameStore, shown_of
from pipeline.stores.sealed_file import sealed
from pipeline.stores.store import TABLE
from pipeline.stores.trajectory_store import TrajectoryStore, verdicts_of
from pipeline.tables import read_table
from pipeline.testset.benchmark import TestSet
from pipeline.types import Verdict


@pytest.fixture(scope="module", autouse=True)
def one_scene(opened: LastScene) -> Iterator[None]:
    """All tests render the same scene, which stays open from one to the next."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.run.render_job.scene_of_process", lambda: opened)
        yield


@pytest.fixture(scope="module")
def config(short_demos: Path) -> Config:
    fields = tiny_config(short_demos)
    fields["demos"] = {"source": "hdf5", "root": str(short_demos), "tasks": [f"{BOWL.suite}/{BOWL.name}"]}
    fields["plan"] = {"seed": 7, "axes": {"light": {}}, "episodes": {"light": 1}, "reserve": 1.0}
    return Config.model_validate(fields)


@pytest.fixture(scope="module")
def rows(config: Config) -> list[plan.Row]:
    """A clean twin, a light episode and its reserve."""
    return plan.make(config.demos.index().entries, config.plan, config.replay, TestSet(()))


@pytest.fixture(scope="module")
def whole_replay(config: Config, rows: list[plan.Row], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole_replay")
    judged = Replays(config.demos, config.replay, folder, loop).of(rows)
    TrajectoryStore(folder).keep(judged)
    assert all(verdict.kept for verdict in judged.values())
    return folder


@pytest.fixture(scope="module")
def replayed(whole_replay: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without what follows the first three steps: most tests render it."""
    whole, store = TrajectoryStore(whole_replay), TrajectoryStore(tmp_path_factory.mktemp("replayed"))
    (name,) = whole.names()
    one = whole.load(name)
    store.save(replace(one, states=one.states[:4], actions=one.actions[:3], site_alpha=one.site_alpha[:4]))
    store.keep([name])
    return store.root


@pytest.fixture
def trajectories(whole_replay: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole_replay, tmp_path / "trajectories"))


def test_the_table_spares_opening_the_files(replayed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = TrajectoryStore(replayed).rows()
    assert len(rows) == 1

    def never(*_: object, **__: object) -> None:
        raise AssertionError("a file was opened although the table tells what is in it")

    monkeypatch.setattr(h5py, "File", never)
    assert TrajectoryStore(replayed).rows() == rows


def test_quality_is_stored_and_a_filter_drops_by_it(config: Config, rows: list[plan.Row], replayed: Path) -> None:
    store = TrajectoryStore(replayed)
    ((name, told),) = store.rows().items()
    quality = store.load(name).quality
    assert quality is not None
    figures = asdict(quality)
    assert {column: told[column] for column in figures} == figures
    assert set(FilterConfig.model_fields) == set(figures)
    assert verdicts_of(store.rows(), FilterConfig()) == {name: Verdict(True, "kept")}
    for column, figure in figures.items():
        if column == "joint_margin_rad":
            refusing, letting = figure + 0.01, figure
        else:
            refusing, letting = figure * 0.99, figure
        if figure > 0:
            refused = verdicts_of(store.rows(), FilterConfig(**{column: refusing}))
            assert refused == {name: Verdict(False, column)}
        assert verdicts_of(store.rows(), FilterConfig(**{column: letting}))[name].kept

    limits = FilterConfig(path_m=figures["path_m"] / 2)
    judged = Replays(config.demos, config.replay, replayed, nothing_to_do, limits).of(rows)
    assert set(judged.values()) == {Verdict(False, "path_m")}


def test_a_lost_or_damaged_table_is_rebuilt(trajectories: Path) -> None:
    rows = TrajectoryStore(trajectories).rows()
    (trajectories / TABLE).write_bytes(b"PAR1 and then nothing")
    assert TrajectoryStore(trajectories).rows() == rows
    (trajectories / TABLE).unlink()
    assert TrajectoryStore(trajectories).refresh() == rows
    assert (trajectories / TABLE).exists()


def _shorten(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def _remove(file: Path) -> None:
    file.unlink()


def _make_foreign(file: Path) -> None:
    store = TrajectoryStore(file.parent)
    trajectory, store.made_by = store.load(file.stem), "somebody else"
    store.save(trajectory)


def _take_out_states(file: Path) -> None:
    with h5py.File(file, "r+") as opened:
        del opened["states"]


@pytest.mark.parametrize("fault", [_shorten, _remove, _make_foreign, _take_out_states])
def test_a_trajectory_that_is_lost_after_replay_stops_what_comes_after_and_is_made_again(
    config: Config, rows: list[plan.Row], trajectories: Path, fault: Any
) -> None:
    file = next(trajectories.glob("*.h5"))
    before = file.read_bytes()
    fault(file)
    with pytest.raises(PipelineError, match=rf"(?s){file.name}.*stages/replay.py CONFIG"):
        outcome.replayed(rows, trajectories)
    Replays(config.demos, config.replay, trajectories, loop).of(rows)
    assert file.read_bytes() == before
    assert outcome.replayed(rows, trajectories)


@pytest.mark.parametrize("error", [MemoryError("mine"), KeyError("mine"), ValueError("mine"), OSError("mine")])
def test_an_error_of_who_reads_a_file_is_not_called_damage(replayed: Path, error: Exception) -> None:
    store = TrajectoryStore(replayed)
    (name,) = store.names()
    with pytest.raises(type(error)) as caught, store.opened(name):
        raise error
    assert caught.value is error


def test_a_file_that_does_not_fit_into_memory_is_not_called_damaged(tmp_path: Path) -> None:
    store = TrajectoryStore(tmp_path)
    with store.created("large", {"mode": "open_loop"}) as file:
        file["states"] = np.zeros(2**23)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    with pytest.raises(MemoryError), limited(resource.RLIMIT_AS, used + 2**25), store.opened("large") as read:
        read.array("states")


def test_a_table_that_does_not_fit_into_memory_is_not_called_damaged(
    replayed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short_of_memory(*_: object, **__: object) -> None:
        raise pa.ArrowMemoryError("malloc of size 64 failed")

    # In place of a limit, under which PyArrow may wait for ever for a thread that it cannot start.
    monkeypatch.setattr(pq, "ParquetFile", short_of_memory)
    with pytest.raises(MemoryError):
        read_table(replayed / TABLE, [], "")


def test_files_that_the_system_does_not_open_are_not_called_missing(trajectories: Path) -> None:
    """Or a stage would make them again, and delete them."""
    store = TrajectoryStore(trajectories)
    (name,) = store.names()
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    with limited(resource.RLIMIT_NOFILE, free), pytest.raises(OSError, match="Too many open files") as caught:
        store.row(name)
    assert caught.value.errno == errno.EMFILE


@pytest.mark.parametrize(("name", "place"), [("states", (3, 1)), ("actions", (2, 0))])
def test_a_changed_number_is_not_read(trajectories: Path, name: str, place: Any) -> None:
    file = next(trajectories.glob("*.h5"))
    with h5py.File(file, "r+") as opened:
        opened[name][place] = -opened[name][place]
    with pytest.raises(PipelineError, match=rf"damaged .*{name}(?s:.*)delete the file"):
        TrajectoryStore(trajectories).load(file.stem)


def test_no_flipped_bit_is_read(trajectories: Path) -> None:
    """Either the file is refused, or what is read is what was written."""
    file = next(trajectories.glob("*.h5"))
    store = TrajectoryStore(trajectories)
    loaded = store.load(file.stem)
    # Half of them in the first part, which has HDF5's own structure.
    places = rng("test_stores").integers([2048, file.stat().st_size], size=(60, 2)).ravel()
    results = read_with_flipped_bits(file, places, lambda: store.load(file.stem))
    for read in results:
        for name, value in vars(loaded).items():
            assert np.array_equal(getattr(read, name), value), name
    assert len(places) - len(results) > len(places) / 2


@pytest.fixture
def next_recipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[identity.Step], None]]:
    """Raises the recipe number of a step, until the test is over."""

    def raised(step: identity.Step) -> None:
        identity._parts.cache_clear()
        monkeypatch.setitem(identity.RECIPES, step, identity.RECIPES[step] + 1)

    yield raised
    identity._parts.cache_clear()


@pytest.mark.parametrize("step", identity.RECIPES)
def test_another_recipe_makes_its_step_and_all_that_build_on_it_anew(
    step: identity.Step, next_recipe: Callable[[identity.Step], None]
) -> None:
    before = {each: identity.fingerprint(each) for each in identity.RECIPES}
    next_recipe(step)
    changed = {each for each in identity.RECIPES if identity.fingerprint(each) != before[each]}
    chain: list[identity.Step] = ["physics", "pixels", "encoding"]
    behind = {"checks", "pictures", *chain[chain.index(step) :]} if step in chain else {step}
    assert changed == behind


@pytest.mark.parametrize("step", ["physics", "pixels"])
def test_finished_work_is_made_anew_only_where_that_was_allowed(
    step: identity.Step,
    config: Config,
    rows: list[plan.Row],
    replayed: Path,
    next_recipe: Callable[[identity.Step], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Config, "data", tmp_path)
    monkeypatch.delenv(identity.REMAKE, raising=False)
    shutil.copytree(replayed, tmp_path / "trajectories")
    store = FrameStore(tmp_path / "frames", config.render)
    store.keep(render_plan(rows, config, replayed, tmp_path / "frames", loop))
    assert not outdated(rows, config, gl.choose().device)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}

    next_recipe(step)
    number = f"recipe of {step} {identity.RECIPES[step] - 1}, here {identity.RECIPES[step]}"
    found = outdated(rows, config)
    told = {f"files of frames, made with {number}": 1}
    assert found == told | ({f"trajectories, made with {number}": 1} if step == "physics" else {})
    with pytest.raises(PipelineError, match=rf"1 files of frames, made with {number}(?s:.*)REMAKE=1` before"):
        identity.refuse_unasked(found, tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before
    monkeypatch.setenv(identity.REMAKE, "1")
    identity.refuse_unasked(found, tmp_path)
    assert number in capsys.readouterr().out
    if step == "pixels":
        monkeypatch.delenv(identity.REMAKE)
        again = FrameStore(tmp_path / "frames", config.render)
        again.keep(render_plan(rows, config, replayed, tmp_path / "frames", loop))
        assert not outdated(rows, config, gl.choose().device), "a remake is asked for once"
        assert again._known().keys() == {again.made_by}


@pytest.mark.parametrize("value", ["", "0", "no"])
def test_only_remake_1_allows_it(value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(identity.REMAKE, value)
    with pytest.raises(PipelineError, match="finished work would be made anew: 2 files"):
        identity.refuse_unasked(Counter({"files": 2}), tmp_path)


def test_what_the_user_changed_is_made_without_a_question(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Config, "data", tmp_path)
    shutil.copytree(replayed, tmp_path / "trajectories")
    store = FrameStore(tmp_path / "frames", config.render)
    store.keep(render_plan(rows, config, replayed, tmp_path / "frames", loop))
    other = config.model_copy(update={"render": config.render.model_copy(update={"jpeg_quality": 80})})
    assert not FrameStore(tmp_path / "frames", other.render).rows()
    assert not outdated(rows, other, gl.choose().device)
    device = outdated(rows, config, "another device")
    assert device == {f"files of frames, made with OpenGL device {gl.choose().device}, here another device": 1}
    assert not outdated([], config), "a file that no episode of today's plan needs"


def test_files_that_nobody_wrote_down_what_they_were_made_with_are_not_replaced_unasked(
    config: Config, rows: list[plan.Row], trajectories: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of the versions before."""
    monkeypatch.setattr(Config, "data", trajectories.parent)
    _make_foreign(next(trajectories.glob("*.h5")))
    assert outdated(rows, config) == {"trajectories, made with something that was not written down": 1}
    _shorten(next(trajectories.glob("*.h5")))
    assert not outdated(rows, config), "a damaged file is made again anyway"


@pytest.mark.parametrize("change", [_shorten, _remove])
def test_the_table_no_longer_tells_of_files_that_are_gone_or_changed(trajectories: Path, change: Any) -> None:
    """DVC looks at the table alone, and starts the stage that makes the file again."""
    store, table = TrajectoryStore(trajectories), trajectories / TABLE
    before = table.read_bytes()
    store.notice_changes()
    assert table.read_bytes() == before
    change(next(trajectories.glob("*.h5")))
    store.notice_changes()
    assert table.read_bytes() != before
    assert not store.rows()


def test_another_quality_and_another_shape_of_frames_are_other_frames(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made_by() -> str:
        return FrameStore(tmp_path, config.render).made_by

    today = made_by()
    assert FrameStore(tmp_path, config.render.model_copy(update={"jpeg_quality": 80})).made_by != today
    smaller = SCHEMA.frame.model_copy(update={"shape": (128, 128, 3)})
    monkeypatch.setattr("pipeline.stores.frame_store.SCHEMA", SCHEMA.model_copy(update={"frame": smaller}))
    assert made_by() != today


NIGHT = LightPerturbation(component="diffuse", level=5, diffuse_scale_rgb=(0.0, 0.0, 0.0))


@pytest.fixture
def rejecting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame under a changed light counts as too dark: LIBERO's head light keeps real draws from being so."""
    monkeypatch.setattr("pipeline.rendering.sight.exposure", lambda frame: "too_dark")


def without_twins(rows: Sequence[plan.Row]) -> list[plan.Row]:
    return [row for row in rows if row.role != "twin"]


@pytest.mark.usefixtures("rejecting")
def test_rendering_ends_when_all_streams_of_a_trajectory_are_rejected(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    lights = without_twins(rows)
    assert len(lights) == 2
    passes: list[int] = []

    def counted(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
        passes.append(len(items))
        return loop(fn, items, description)

    render_plan(lights, config, replayed, tmp_path, counted)
    stored = shown_of(FrameStore(tmp_path, config.render).rows())
    (shown,) = stored.values()
    assert shown.streams == set()
    assert len(shown.rejected) == 4, "two views of the light episode and of its reserve"
    assert outcome.rejections(lights, stored) == dict.fromkeys((row.episode_id for row in lights), "too_dark")
    rendered = len(passes)
    render_plan(lights, config, replayed, tmp_path, counted)
    assert len(passes) == rendered, "a second run has nothing to do"


def test_frames_are_the_same_in_one_file_and_in_several(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a trajectory has more streams than a job renders."""
    render_plan(rows, config, replayed, tmp_path / "one", loop)
    monkeypatch.setattr("pipeline.run.render_stage.STREAMS_OF_A_JOB", 1)
    files = render_plan(rows, config, replayed, tmp_path / "several", loop)
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
        rendered = render_plan(planned, config, replayed, tmp_path / folder, loop)
        (store.root / "0123.h5").write_bytes(b"all frames of a trajectory, as an earlier version stored them")
        store.keep(rendered)
        return {path.relative_to(store.root).as_posix(): path.read_bytes() for path in store.root.rglob("*.h5")}

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
    (name,) = render_plan(rows[:1], config, replayed, tmp_path, loop)
    geometry = [stream.geometry.stream_id for stream in streams_of(rows[0].perturbations).values()]
    twin = store.load(trajectory_id, store.rows()[name]["streams"], geometry)
    store.path(name).unlink()
    store.save(trajectory_id, replace(twin, rejected={"earlier": "too_dark"}), gl.choose().device)
    store.keep(render_plan(rows[:1], config, replayed, tmp_path, loop))
    (row,) = store.rows().values()
    assert json.loads(row["rejected"]) == {}
    assert row["streams"] == sorted(twin.streams)


def test_a_damaged_file_is_rendered_again_and_hinders_no_other(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.run.render_stage.STREAMS_OF_A_JOB", 2)
    files = render_plan(rows, config, replayed, tmp_path, loop)
    store = FrameStore(tmp_path, config.render)
    whole, damaged = sorted(files)
    before = store.path(damaged).read_bytes()
    streams = store.rows()[whole]["streams"]
    _shorten(store.path(damaged))
    assert store.load(rows[0].trajectory_id, streams).streams.keys() == set(streams)
    assert render_plan(rows, config, replayed, tmp_path, loop) == files
    assert store.path(damaged).read_bytes() == before


@pytest.mark.parametrize("number", [1, 64, 65, 600])
def test_a_job_has_so_many_streams_at_most(number: int) -> None:
    """And what is not needed changes its own portion alone."""
    lights = [NIGHT.model_copy(update={"diffuse_scale_rgb": (0.0, 0.0, step / number)}) for step in range(number)]
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

    with pytest.raises(PipelineError, match="still not there"):
        render_plan(rows[:1], config, replayed, tmp_path, elsewhere)


def given_up(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
    """What a cluster does with work that no worker survives; see tests/compute/test_compute.py for workers that die."""
    return [fn.lost(item) for item in items]


def nothing_to_do(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
    raise AssertionError(f"{description}: {len(items)} items are made again")


def test_a_replay_that_is_given_up_is_dropped_with_its_reason_and_not_tried_again(
    config: Config, rows: list[plan.Row], tmp_path: Path
) -> None:
    judged = Replays(config.demos, config.replay, tmp_path, given_up).of(rows)
    assert judged == {rows[0].trajectory_id: Verdict(False, "worker_lost")}
    assert Replays(config.demos, config.replay, tmp_path, nothing_to_do).of(rows) == judged
    assert {verdict.reason for verdict in selection.select(rows, judged).values()} == {"worker_lost"}
    assert "too long" in TrajectoryStore(tmp_path).load(rows[0].trajectory_id).resolved
    assert outcome.replayed(rows, tmp_path)


def test_a_rendering_that_is_given_up_is_dropped_with_its_reason_and_keeps_what_was_there(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    render_plan(rows, config, replayed, tmp_path / "at_once", given_up)
    stored = shown_of(FrameStore(tmp_path / "at_once", config.render).rows())
    assert set(outcome.rejections(rows, stored).values()) == {"worker_lost"}
    render_plan(rows, config, replayed, tmp_path / "at_once", nothing_to_do)

    twin, lights = rows[:1], without_twins(rows)
    render_plan(twin, config, replayed, tmp_path / "later", loop)
    render_plan(rows, config, replayed, tmp_path / "later", given_up)
    stored = shown_of(FrameStore(tmp_path / "later", config.render).rows())
    assert outcome.rejections(rows, stored) == dict.fromkeys((row.episode_id for row in lights), "worker_lost")
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


def test_a_reserve_is_replayed_once_frames_before_it_are_refused(rows: list[plan.Row]) -> None:
    start = RobotPerturbation(component="initial_joints", level=1, joint_offsets_rad=(0.01,) * 7)
    first, second, third = (
        plan.Row(
            **{**vars(without_twins(rows)[0]), "axis": "robot", "perturbations": to_json((start,)), "rank": rank}
            | {"trajectory_id": name, "episode_id": name, "wanted": not rank}
        )
        for rank, name in enumerate("abc")
    )
    both, kept = [first, second, third], Verdict(True, "kept")
    assert selection.pending(both, {}) == ["a"]
    assert selection.pending(both, {"a": kept}) == []
    assert selection.pending(both, {"a": kept}, {"a": "worker_lost"}) == ["b"]
    assert selection.pending(both, {"a": kept, "b": kept}, {"a": "worker_lost", "b": "too_dark"}) == ["c"]
    judged = selection.select(both, {"a": kept, "b": kept}, {"a": "worker_lost"})
    assert [verdict.reason for verdict in judged.values()] == ["worker_lost", "kept", "reserve_not_needed"]


def test_a_refusal_of_a_reserve_that_is_no_longer_needed_is_forgotten(
    config: Config, rows: list[plan.Row], replayed: Path, tmp_path: Path
) -> None:
    """As when the refused frames before it are deleted, to be tried again."""
    store = FrameStore(tmp_path, config.render)
    expected = render_plan(rows, config, replayed, tmp_path, loop)
    store.keep(())
    render_plan([replace(rows[2], wanted=True)], config, replayed, tmp_path, given_up)
    assert outcome.rejections(rows, shown_of(store.rows())) == {rows[2].episode_id: "worker_lost"}
    assert render_plan(rows, config, replayed, tmp_path, loop) == expected


def test_a_file_has_the_same_bytes_whoever_still_holds_one_of_its_arrays(tmp_path: Path) -> None:
    held = []
    for name, holds in (("alone.h5", False), ("held.h5", True)):
        with sealed(tmp_path / name, {"reason": "none"}) as file:
            array = file.create_dataset("site_alpha", data=np.zeros((100, 31), np.float32), compression="gzip")
            held += [array] * holds
            del array
    assert (tmp_path / "alone.h5").read_bytes() == (tmp_path / "held.h5").read_bytes()
