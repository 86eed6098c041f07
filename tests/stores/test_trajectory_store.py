"""A stored trajectory is read whole or not at all, the table tells of it without opening files, and nothing is lost."""

import errno
import os
import resource
import shutil
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bowl import bowl_config, bowl_plan, given_up, nothing_to_do, replay_bowl
from conftest import Once
from faults import limited, read_with_flipped_bits
from short_runs import run_in

from pipeline.compute.pool import loop
from pipeline.config import Config, FilterConfig
from pipeline.errors import PipelineError
from pipeline.planning import plan, selection
from pipeline.run.outcome import outdated, reject_missing_replays
from pipeline.run.progress import Progress
from pipeline.run.replay_stage import Replays
from pipeline.run.verdicts import verdicts_of
from pipeline.seeding import rng
from pipeline.stores.sealed_file import HEADER
from pipeline.stores.store import TABLE
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.tables import read_table
from pipeline.types import Verdict


@pytest.fixture(scope="module")
def config(short_demos: Path) -> Config:
    return bowl_config(short_demos)


@pytest.fixture(scope="module")
def rows(config: Config) -> list[plan.Row]:
    return bowl_plan(config)


@pytest.fixture(scope="module")
def whole_replay(config: Config, once: Once) -> Path:
    return once("bowl", partial(replay_bowl, config))


@pytest.fixture
def trajectories(whole_replay: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole_replay, tmp_path / "trajectories"))


def test_the_table_spares_opening_the_files(whole_replay: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = TrajectoryStore(whole_replay).rows()
    assert len(rows) == 1

    def never(*_: object, **__: object) -> None:
        raise AssertionError("a file was opened although the table tells what is in it")

    monkeypatch.setattr("pipeline.stores.sealed_file.ZipFile", never)
    assert TrajectoryStore(whole_replay).rows() == rows


def test_quality_is_stored_and_a_filter_drops_by_it(config: Config, rows: list[plan.Row], whole_replay: Path) -> None:
    store = TrajectoryStore(whole_replay)
    ((name, told),) = store.rows().items()
    quality = store.load(name).quality
    assert quality is not None
    figures = asdict(quality)
    assert {column: told[column] for column in figures} == figures
    assert set(FilterConfig.model_fields) == {*figures, "exceeds_step_limit"}
    assert verdicts_of(store.rows(), rows, FilterConfig()) == {name: Verdict(True, "kept")}
    for column, figure in figures.items():
        if column == "joint_margin_rad":
            rejecting, accepting = figure + 0.01, figure
        else:
            rejecting, accepting = figure * 0.99, figure
        if figure > 0:
            rejected = verdicts_of(store.rows(), rows, FilterConfig(**{column: rejecting}))
            assert rejected == {name: Verdict(False, column)}
        assert verdicts_of(store.rows(), rows, FilterConfig(**{column: accepting}))[name].kept

    limits = FilterConfig(path_m=figures["path_m"] / 2)
    judged = Replays(config.demos, config.replay, TrajectoryStore(whole_replay), nothing_to_do, limits).complete(rows)
    assert set(judged.values()) == {Verdict(False, "path_m")}


@pytest.mark.parametrize("name", ["../notes", "/notes", "deep/../../notes", ".."])
def test_a_name_that_leaves_the_folder_is_rejected(name: str, tmp_path: Path) -> None:
    """The ids of a manifest are names of files, and a manifest may be of other origin."""
    with pytest.raises(PipelineError, match="would be outside this folder"):
        TrajectoryStore(tmp_path / "trajectories").path(name)


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
    trajectory = store.load(file.stem)
    store.basis = replace(store.basis, identity="somebody else")
    store.save(trajectory)


def _rewrite(file: Path, change: Callable[[dict[str, bytes]], object]) -> None:
    """Write a file again with changed members; the container's own checksums fit them."""
    with ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def reject_missing(config: Config, rows: list[plan.Row], trajectories: Path) -> None:
    """Stop if a trajectory of a plan is missing, as the stages after ``replay`` do."""
    store = TrajectoryStore(trajectories)
    reject_missing_replays(Progress.of(rows, store.rows(), {}, config), store)


def _take_out_states(file: Path) -> None:
    _rewrite(file, lambda members: members.pop("states.npy"))


@pytest.mark.parametrize("fault", [_shorten, _take_out_states])
def test_a_damaged_trajectory_is_an_error_with_its_reason_and_is_never_silently_replayed(
    config: Config, rows: list[plan.Row], trajectories: Path, fault: Any
) -> None:
    file = next(trajectories.glob("*.npz"))
    whole = file.read_bytes()
    fault(file)
    damaged = file.read_bytes()
    for read in (
        lambda: TrajectoryStore(trajectories).row(file.stem),
        lambda: TrajectoryStore(trajectories).load(file.stem),
        lambda: reject_missing(config, rows, trajectories),
        lambda: Replays(config.demos, config.replay, TrajectoryStore(trajectories), nothing_to_do).complete(rows),
    ):
        with pytest.raises(
            PipelineError, match=rf"(?s){file.name}: the file is damaged \(.+\).*move the file to another place"
        ):
            read()
    assert file.read_bytes() == damaged
    file.rename(trajectories.parent / "moved away")
    Replays(config.demos, config.replay, TrajectoryStore(trajectories), loop).complete(rows)
    assert file.read_bytes() == whole


@pytest.mark.parametrize("fault", [_remove, _make_foreign])
def test_a_trajectory_that_is_lost_after_replay_stops_what_comes_after_and_is_made_again(
    config: Config, rows: list[plan.Row], trajectories: Path, fault: Any
) -> None:
    file = next(trajectories.glob("*.npz"))
    before = file.read_bytes()
    fault(file)
    with pytest.raises(PipelineError, match=rf"(?s){file.name}.*stages/replay.py CONFIG"):
        reject_missing(config, rows, trajectories)
    Replays(config.demos, config.replay, TrajectoryStore(trajectories), loop).complete(rows)
    assert file.read_bytes() == before
    reject_missing(config, rows, trajectories)


@pytest.mark.parametrize("error", [MemoryError("mine"), KeyError("mine"), ValueError("mine"), OSError("mine")])
def test_an_error_of_who_reads_a_file_is_not_called_damage(whole_replay: Path, error: Exception) -> None:
    store = TrajectoryStore(whole_replay)
    (name,) = store.names()
    with pytest.raises(type(error)) as caught, store.opened(name):
        raise error
    assert caught.value is error


def test_a_file_that_does_not_fit_into_memory_is_not_called_damaged(tmp_path: Path) -> None:
    store = TrajectoryStore(tmp_path)
    store.write("large", {"states": np.zeros(2**23)}, {"mode": "open_loop"})
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    with pytest.raises(MemoryError), limited(resource.RLIMIT_AS, used + 2**25), store.opened("large") as read:
        read.array("states")


def test_a_table_that_does_not_fit_into_memory_is_not_called_damaged(
    whole_replay: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short_of_memory(*_: object, **__: object) -> None:
        raise pa.ArrowMemoryError("malloc of size 64 failed")

    # In place of a limit, under which PyArrow may wait for ever for a thread that it cannot start.
    monkeypatch.setattr(pq, "ParquetFile", short_of_memory)
    with pytest.raises(MemoryError):
        read_table(whole_replay / TABLE, [], "")


def test_files_that_the_system_does_not_open_are_not_called_missing(trajectories: Path) -> None:
    """Or a stage would make them again, and delete them."""
    store = TrajectoryStore(trajectories)
    (name,) = store.names()
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    with limited(resource.RLIMIT_NOFILE, free), pytest.raises(OSError, match="Too many open files") as caught:
        store.row(name)
    assert caught.value.errno == errno.EMFILE


@pytest.mark.parametrize("name", ["states", "actions"])
def test_a_changed_number_is_not_read(trajectories: Path, name: str) -> None:
    def change_last_number(members: dict[str, bytes]) -> None:
        content = members[f"{name}.npy"]
        members[f"{name}.npy"] = content[:-8] + bytes(8) if any(content[-8:]) else content[:-8] + b"?" * 8

    file = next(trajectories.glob("*.npz"))
    _rewrite(file, change_last_number)
    with pytest.raises(PipelineError, match=rf"damaged .*{name}(?s:.*)move the file to another place"):
        TrajectoryStore(trajectories).load(file.stem)


def test_no_flipped_bit_is_read(trajectories: Path) -> None:
    """Either the file is rejected, or what is read is what was written."""
    file = next(trajectories.glob("*.npz"))
    store = TrajectoryStore(trajectories)
    loaded = store.load(file.stem)
    # A third in the zip directory at the end, a third in the header before it.
    size = file.stat().st_size
    with ZipFile(file) as archive:
        directory, header = archive.start_dir, archive.getinfo(HEADER).header_offset
    places = rng("test_stores").integers([0, header, directory], [size, directory, size], size=(100, 3)).ravel()
    results = read_with_flipped_bits(file, places, lambda: store.load(file.stem))
    expected = vars(loaded) | vars(loaded.scene)
    for read in results:
        found = vars(read) | vars(read.scene)
        for name in expected.keys() - {"scene"}:
            assert np.array_equal(found[name], expected[name]), name
    assert len(places) - len(results) > len(places) / 2


def test_2000_files_are_read_while_another_thread_keeps_the_frames_of_the_reader(
    trajectories: Path, tmp_path: Path
) -> None:
    """As a profiler does: with the frames it keeps the files and arrays that they hold."""
    store = TrajectoryStore(trajectories)
    (name,) = store.names()
    whole = store.load(name)
    store.save(replace(whole, states=whole.states[:4], actions=whole.actions[:3], site_alpha=whole.site_alpha[:4]))
    content = store.path(name).read_bytes()
    names = [f"{number:04}" for number in range(2000)]
    for each in names:
        store.path(each).write_bytes(content)
    kept, done = deque[object](maxlen=20), threading.Event()

    def keep_frames() -> None:
        while not done.wait(0.0005):
            kept.append(sys._current_frames())

    profiler = threading.Thread(target=keep_frames)
    profiler.start()
    errors = []
    try:
        for each in names:
            try:
                assert np.array_equal(store.load(each).actions, whole.actions[:3])
            except (PipelineError, AssertionError) as error:
                errors.append(str(error))
    finally:
        done.set()
        profiler.join()
    assert len(errors) == 0, errors[:3]


def test_files_that_nobody_wrote_down_what_they_were_made_with_are_not_replaced_unasked(
    rows: list[plan.Row], trajectories: Path
) -> None:
    """As those of the versions before."""
    run = run_in(trajectories.parent)
    _make_foreign(next(trajectories.glob("*.npz")))
    assert outdated(rows, run.trajectories, run.frames) == {"trajectories": {"unrecorded versions and settings": 1}}
    _shorten(next(trajectories.glob("*.npz")))
    with pytest.raises(PipelineError, match="damaged"):
        outdated(rows, run.trajectories, run.frames)


def test_hdf5_files_of_an_earlier_version_are_not_replaced_unasked(rows: list[plan.Row], trajectories: Path) -> None:
    run = run_in(trajectories.parent)
    file = next(trajectories.glob("*.npz"))
    file.rename(file.with_suffix(".h5"))
    frames = trajectories.parent / "frames" / file.stem / "0123456789abcdef.h5"
    frames.parent.mkdir(parents=True)
    frames.write_bytes(b"frames of an earlier version")
    earlier = {"the HDF5 container of an earlier version": 1}
    assert outdated(rows, run.trajectories, run.frames) == {"trajectories": earlier, "files of frames": earlier}


def test_the_table_no_longer_tells_of_a_file_that_is_gone(trajectories: Path) -> None:
    """DVC looks at the table alone, and starts the stage that makes the file again."""
    store, table = TrajectoryStore(trajectories), trajectories / TABLE
    before = table.read_bytes()
    store.notice_changes()
    assert table.read_bytes() == before
    _remove(next(trajectories.glob("*.npz")))
    store.notice_changes()
    assert table.read_bytes() != before
    assert not store.rows()


def test_a_replay_that_is_given_up_is_dropped_with_its_reason_and_not_tried_again(
    config: Config, rows: list[plan.Row], tmp_path: Path
) -> None:
    judged = Replays(config.demos, config.replay, TrajectoryStore(tmp_path), given_up).complete(rows)
    assert judged == {rows[0].trajectory_id: Verdict(False, "worker_lost")}
    assert Replays(config.demos, config.replay, TrajectoryStore(tmp_path), nothing_to_do).complete(rows) == judged
    assert {verdict.reason for verdict in selection.select(rows, judged).values()} == {"worker_lost"}
    assert "too long" in TrajectoryStore(tmp_path).load(rows[0].trajectory_id).resolved
    reject_missing(config, rows, tmp_path)
