"""Work spread over processes: the same results in the same order, and a worker's error as it was raised."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.run.compute import loop, runner


def square(number: int) -> int:
    return number * number


def process(_: int) -> int:
    time.sleep(0.1)  # or one worker may do all before the other is asked
    return os.getpid()


def refuse(number: int) -> int:
    if number == 2:
        raise PipelineError("two is refused", where="item 2", expected="another number", remedy="leave it out")
    return number


@pytest.mark.slow
def test_local_processes_and_a_scheduler_by_address(tmp_path: Path) -> None:
    numbers = list(range(20))
    with runner(ComputeConfig(cluster="local", workers=2), tmp_path) as run:
        assert run(square, numbers, "squares") == [n * n for n in numbers] == loop(square, numbers, "squares")
        workers = set(run(process, numbers, "processes"))
        assert len(workers) == 2
        assert os.getpid() not in workers
        with pytest.raises(PipelineError, match="item 2: two is refused") as caught:
            run(refuse, numbers, "refusals")
        assert caught.value.remedy == "leave it out"

        from distributed import get_client

        address = get_client().scheduler.address
        with runner(ComputeConfig(cluster=address), tmp_path) as elsewhere:
            assert set(elsewhere(process, numbers, "processes")) == workers
        assert list(tmp_path.iterdir()) == []


def test_no_scheduler_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import dask

    monkeypatch.setattr("pipeline.run.compute.CONNECT_S", 1)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(PipelineError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"),
        runner(ComputeConfig(cluster="tcp://127.0.0.1:9"), tmp_path),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["plan", "export_rlds", "export_lerobot", "manifest"])
def test_only_replay_and_render_load_the_simulator(stage: str) -> None:
    script = (
        f"import sys, runpy; runpy.run_path('stages/{stage}.py'); "
        "print([name for name in ('mujoco', 'robosuite', 'tensorflow') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
