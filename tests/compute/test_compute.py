"""Work spread over processes: the same results in the same order, and a worker's error as it was raised."""

import os
import re
import resource
import socket
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import psutil
import pytest
from checkout import REPOSITORY
from compute_work import (
    BLOCK_BYTES,
    DieOrHangJob,
    SquareJob,
    die,
    gpu,
    mark,
    pages_asked_for,
    process,
    reject_two,
    square,
)
from distributed import LocalCluster, Nanny

from pipeline import gl
from pipeline.compute.pool import TRIES, loop, run_job, runner
from pipeline.compute.progress import progress_of
from pipeline.compute_config import ComputeConfig
from pipeline.errors import PipelineError


@pytest.mark.slow
def test_local_processes_and_a_scheduler_by_address(tmp_path: Path) -> None:
    numbers = list(range(20))
    with runner(ComputeConfig(cluster="local", workers=2), tmp_path) as run:
        assert run(square, numbers, "squares") == [n * n for n in numbers] == loop(square, numbers, "squares")
        workers = set(run(process, numbers, "processes"))
        assert len(workers) == 2
        assert os.getpid() not in workers
        with pytest.raises(PipelineError, match="item 2: two is rejected") as caught:
            run(reject_two, numbers, "rejections")
        assert caught.value.remedy == "leave it out"

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
        runner(ComputeConfig(cluster=cluster.scheduler_address), tmp_path) as run,
    ):
        assert run(square, numbers, "squares") == [n * n for n in numbers]
        assert workers.isdisjoint(run(process, numbers, "processes"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_worker_keeps_the_memory_that_it_frees(tmp_path: Path) -> None:
    with runner(ComputeConfig(cluster="local", workers=1), tmp_path) as run:
        (pages,) = run(pages_asked_for, [100], "pages")
    assert pages < 10 * BLOCK_BYTES // resource.getpagesize(), "not each time"


@pytest.mark.slow
def test_workers_have_the_gpus_in_turn_and_so_have_those_that_replace_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # None that is there: a worker that tried what renders would find another.
    monkeypatch.setattr(gl, "choose", lambda: gl.GlChoice("egl", "two GPUs", "a test"))
    monkeypatch.setattr(gl, "gpus", lambda: ("0", "2"))
    with runner(ComputeConfig(cluster="local", workers=3), tmp_path, renders=True) as run:
        found = sorted((device, index or "", sharing) for _, device, index, sharing in set(run(gpu, range(30), "GPUs")))
        assert found == [("two GPUs", "0", 2), ("two GPUs", "0", 2), ("two GPUs", "2", 2)]
        with pytest.raises(PipelineError, match=f"ended {TRIES} workers"):
            run(die, [1], "deaths")
        assert {(device, index, sharing) for _, device, index, sharing in run(gpu, range(30), "GPUs")} <= set(found)


def test_progress_is_counted_in_what_items_hold(capsys: pytest.CaptureFixture[str]) -> None:
    """Else a bar of few large items stands still, and the time that is left is wrong."""
    jobs = [SquareJob(1), SquareJob(9), SquareJob(10)]
    assert loop(run_job, jobs, "squares, sides") == [1, 81, 100]
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[1].split(": ")[1] for line in lines] == ["10/20", "20/20"]


@pytest.mark.parametrize(("every_s", "lines"), [(60.0, 10), (0.0, 30)])
def test_a_log_says_how_far_long_work_is(
    every_s: float, lines: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not only at each tenth, which takes hours in a large run."""
    monkeypatch.setattr("pipeline.compute.progress.SAID_EVERY_S", every_s)
    loop(square, range(30), "squares")
    assert len(capsys.readouterr().err.splitlines()) == lines


@pytest.mark.slow
def test_work_that_ends_its_workers_is_given_up_or_ends_the_run_with_words(tmp_path: Path) -> None:
    jobs = [DieOrHangJob(number) for number in (1, 2, 3, 4, 5)]
    with runner(ComputeConfig(cluster="local", workers=2), tmp_path) as run:
        assert run(run_job, jobs, "some deaths") == [1, -2, -3, 4, 5]
        with pytest.raises(PipelineError, match=f"ended {TRIES} workers"):
            run(die, [1], "deaths")
        assert run(square, [3], "squares") == [9], "a new worker has come"


@pytest.mark.slow
@pytest.mark.parametrize("deaths", [1, TRIES])
def test_workers_that_die_while_they_start_are_started_again(deaths: int, tmp_path: Path) -> None:
    def kill_the_first_of_each_start() -> None:
        killed: set[int] = set()
        while len(killed) < deaths:
            for worker in _workers_here():
                if worker.pid not in killed and len(killed) < deaths:
                    worker.kill()
                    killed.add(worker.pid)
            time.sleep(0.01)

    killer = threading.Thread(target=kill_the_first_of_each_start, daemon=True)
    killer.start()
    failure = pytest.raises(PipelineError, match=f"{TRIES} times(?s:.*)reduce compute.workers")
    with (
        nullcontext() if deaths < TRIES else failure,
        runner(ComputeConfig(cluster="local", workers=1), tmp_path) as run,
    ):
        assert run(square, [3], "squares") == [9]
    killer.join()


def _workers_here() -> list[psutil.Process]:
    return [each for each in psutil.Process().children() if any("spawn_main" in word for word in each.cmdline())]


@pytest.mark.slow
def test_workers_that_are_slow_to_end_do_not_undo_their_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a busy machine, where Dask no longer waits for the process that it has killed."""
    kill = Nanny.kill

    async def killed_too_late(self: Nanny, *arguments: object, **options: object) -> None:
        await kill(self, *arguments, **options)
        raise TimeoutError

    monkeypatch.setattr(Nanny, "kill", killed_too_late)
    with runner(ComputeConfig(cluster="local", workers=1), tmp_path) as run:
        assert run(square, [3], "squares") == [9]


@pytest.mark.slow
@pytest.mark.parametrize(("gone", "message"), [("worker", "no worker is left"), ("scheduler", "scheduler|no worker")])
def test_a_cluster_that_goes_away_is_not_waited_for(
    gone: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import dask
    import distributed  # noqa: F401 - or the end of `set` takes its defaults away, which come with the import

    monkeypatch.setattr("pipeline.compute.pool.ALONE_S", 2)
    monkeypatch.setattr("pipeline.compute.pool.LOOK_S", 1)
    script = Path(sys.executable).parent / "dask"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, (REPOSITORY, REPOSITORY / "tests", REPOSITORY / "tests" / "compute"))),
    }
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    commands = {
        "scheduler": ["scheduler", "--host", address, "--no-dashboard"],
        "worker": ["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"],
    }
    processes = {
        name: subprocess.Popen([script, *words], cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
        for name, words in commands.items()
    }
    working = tmp_path / "working"

    def kill_one_once_there_is_work() -> None:
        while not working.exists():
            time.sleep(0.05)
        processes[gone].kill()

    killer = threading.Thread(target=kill_one_once_there_is_work, daemon=True)
    killer.start()
    try:
        with (
            dask.config.set({"distributed.comm.timeouts.connect": "30s"}),
            pytest.raises(PipelineError, match=message),
            runner(ComputeConfig(cluster=address), tmp_path) as run,
        ):
            run(mark, [working] * 1_000, "work")
    finally:
        for one in processes.values():
            one.kill()
            one.wait()


def test_no_scheduler_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import dask

    monkeypatch.setattr("pipeline.compute.pool.CONNECT_S", 1)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(PipelineError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"),
        runner(ComputeConfig(cluster="tcp://127.0.0.1:9"), tmp_path) as run,
    ):
        run(str, [1], "work")


def test_without_work_nothing_is_started(tmp_path: Path) -> None:
    with runner(ComputeConfig(cluster="tcp://127.0.0.1:9"), tmp_path) as run:
        assert run(str, [], "nothing") == []


@pytest.mark.slow
def test_only_replay_and_render_load_the_simulator() -> None:
    script = (
        "import sys, runpy, pipeline.stages; "
        "[runpy.run_path(f'stages/{stage}.py') for stage in ('plan', 'exports', 'manifest')]; "
        "print([name for name in ('mujoco', 'robosuite', 'tensorflow') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_log_says_how_long_what_is_left_takes(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_of("frames", 10) as advance:
        time.sleep(0.6)
        advance(9)
    # At nine in 0.6 s, the tenth takes 0.07 s; all ten would take 0.7.
    told = re.fullmatch(r"frames: 9/10, (\d+(?:\.\d+)?)/s, 0 s left\n", capsys.readouterr().err)
    assert told
    assert float(told[1]) <= 15
