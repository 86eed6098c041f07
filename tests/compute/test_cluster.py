"""Workers of a cluster that was started elsewhere: the same bytes, nothing of an earlier run, or a clear rejection."""

import os
import re
import runpy
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
import yaml
from checkout import REPOSITORY, link_testset
from PIL import Image
from short_demonstrations import STOVE
from short_runs import tiny_config

from pipeline import gl
from pipeline.axes import Axes
from pipeline.compute import cluster as cluster_module
from pipeline.compute.cluster import Workplace, setup
from pipeline.compute.pool import run_job, runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, PlanConfig, RenderConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.identity import REMAKE, made_with
from pipeline.machine_code import MACHINE_CODE_VARIABLES
from pipeline.planning import plan
from pipeline.run.claim import locked
from pipeline.run.render_job import RenderJob
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet

Start = Callable[..., str]

CLEAN, NONE = PlanConfig(seed=0, axes=Axes(), episodes={}), TestSet(())
"""A plan of twins alone, for which no test tasks matter."""


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Start]:
    """Starts a scheduler, and workers that know nothing of the test's folder; returns the scheduler's address."""
    with ExitStack() as stack:
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        logs = stack.enter_context((tmp_path / "cluster.log").open("w"))

        def spawn(command: str, *options: str, **environment: str) -> None:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{command}", *options],
                cwd=elsewhere,
                # What renders here, a worker finds out by itself.
                env={name: value for name, value in os.environ.items() if "GL" not in name}
                | {"PYTHONPATH": str(REPOSITORY)}
                | environment,
                stdout=logs,
                stderr=logs,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)

        def start(*workers: tuple[int, dict[str, str]]) -> str:
            from distributed import Client

            file = tmp_path / "scheduler.json"
            spawn(
                "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)
            )
            deadline = time.monotonic() + 120
            while not file.exists() and time.monotonic() < deadline:
                time.sleep(0.1)
            # With a nanny, a worker would be a process of a process, and outlive the test.
            options = ("--scheduler-file", str(file), "--no-nanny", "--no-dashboard", "--memory-limit", "0")
            for threads, environment in workers:
                spawn("dask_worker", *options, "--nthreads", str(threads), **environment)
            with Client(scheduler_file=str(file), timeout=60) as client:
                client.wait_for_workers(len(workers), timeout=240)
                return str(client.scheduler.address)

        yield start


def configuration(demos: str, cluster: str, seed: int) -> dict[str, object]:
    """A run with every kind of path that a user may give, all relative."""
    return tiny_config(Path(demos)) | {
        "demos": {"source": "hdf5", "root": demos, "tasks": [f"{STOVE.suite}/{STOVE.name}"]},
        "plan": {
            "seed": seed,
            "axes": {
                "background": {"sources": [{"folder": "textures", "licence": "ours"}], "image_share": 1.0},
                "language": {"bank": "bank.yaml"},
            },
            "episodes": {"background": 1, "language": 1},
        },
        "compute": {"cluster": cluster},
    }


def run(folder: Path, config: dict[str, object], monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Run the stages up to RLDS in ``folder``, from this process; returns what they wrote."""
    file = folder / "configs" / "tiny.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(yaml.safe_dump(config))
    monkeypatch.chdir(folder)
    for stage in ("plan", "replay", "render", "exports"):
        monkeypatch.setattr(sys, "argv", [stage, "configs/tiny.yaml"])
        runpy.run_path(str(REPOSITORY / "stages" / f"{stage}.py"), run_name="__main__")
    data = folder / "data" / "tiny"
    return {str(path.relative_to(data)): path.read_bytes() for path in sorted(data.rglob("*")) if path.is_file()}


def inputs(folder: Path, demos: Path, text: str) -> None:
    shutil.copytree(demos, folder / "demos")
    (folder / "textures").mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(pixels).save(folder / "textures" / "wall of ours.png")
    (folder / "bank.yaml").write_text(yaml.safe_dump({STOVE.suite: {STOVE.name: {"paraphrase": [text]}}}))
    link_testset(folder)


def test_two_runs_on_one_cluster_are_what_they_are_without_it(
    cluster: Start, short_demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = cluster((1, {}))
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
        inputs(folder, short_demos, "please switch on the stove now")
    # The second run has its plan, its frames and its datasets where the first had them, which it may delete.
    monkeypatch.setenv(REMAKE, "1")
    made = [run(there, configuration("demos", address, seed), monkeypatch) for seed in (7, 8)]
    alone = run(here, configuration("demos", "loop", 8), monkeypatch)
    assert made[0] != made[1]
    assert made[1] == alone
    assert sorted(path.name for path in (tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.slow
def test_workers_that_cannot_work_for_the_run_are_rejected_before_they_start(cluster: Start, tmp_path: Path) -> None:
    edited = tmp_path / "edited"
    for name in ("pipeline", "schemas"):
        shutil.copytree(REPOSITORY / name, edited / name, ignore=shutil.ignore_patterns("__pycache__"))
    with (edited / "pipeline" / "seeding.py").open("a") as file:
        file.write("# edited\n")
    # A worker has NumPy before it has this project: with the machine code that its environment asks for.
    other = {"OPENBLAS_CORETYPE": "Sandybridge", "NPY_DISABLE_CPU_FEATURES": ""}
    address = cluster((1, {}), (1, {"PYTHONPATH": str(edited)}), (2, {}), (1, other))
    # Every process has its own folder at this path.
    folder = Path("/proc/self/cwd") / "data"
    with pytest.raises(PipelineError) as caught, runner(ComputeConfig(cluster=address), folder) as work:
        work(str, [0], "none")
    message = str(caught.value)
    assert "4 of 4 workers" in message
    assert f"does not see {folder}" in message
    assert "has code of pipeline " in message
    assert "runs 2 threads" in message
    assert re.search(r"has machine code Sandybridge \w+, but the run has Haswell AVX2", message)
    assert f'OPENBLAS_CORETYPE="{MACHINE_CODE_VARIABLES["OPENBLAS_CORETYPE"]}"' in message
    assert "dask worker ADDRESS --nthreads 1" in message
    assert not list((tmp_path / "elsewhere").rglob("data"))

    from distributed import Client

    # As a worker finds out that joins when the work is under way.
    with (
        Client(address) as client,
        pytest.raises(PipelineError, match=r"does not see .* has Python 3\.\d+\.\d+, but the run has 2"),
    ):
        client.submit(Workplace(Path.cwd(), folder / "token", {"Python": "2"}).enter).result()


@pytest.mark.slow
def test_a_worker_with_another_device_is_rejected(cluster: Start, tmp_path: Path) -> None:
    # The device's name tells the width of its vectors.
    address = cluster((1, {"MUJOCO_GL": "osmesa", "LP_NATIVE_VECTOR_WIDTH": "128"}))
    device = gl.choose().device
    (row,) = plan.make(DemosConfig(tasks=(f"{STOVE.suite}/{STOVE.name}",)).index().entries, CLEAN, ReplayConfig(), NONE)
    job = RenderJob(row, (), tmp_path / "trajectories", tmp_path / "frames", RenderConfig(), device)
    with (
        runner(ComputeConfig(cluster=address), tmp_path / "data") as work,
        pytest.raises(PipelineError, match="this worker renders with") as caught,
    ):
        work(run_job, [job], "render")
    assert device in str(caught.value)
    assert not (tmp_path / "frames").exists()


BUSY = """
import sys, time
from pathlib import Path
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
with runner(ComputeConfig(cluster=sys.argv[1]), Path(sys.argv[2])) as work:
    work(time.sleep, [0.5] * 120, "busy")
"""


@pytest.mark.slow
def test_the_next_stage_deletes_what_a_killed_run_left_for_its_workers(cluster: Start, tmp_path: Path) -> None:
    data, environment = tmp_path / "data", os.environ | {"PYTHONPATH": str(REPOSITORY)}
    busy = subprocess.Popen([sys.executable, "-c", BUSY, cluster((1, {})), str(data)], cwd=tmp_path, env=environment)
    deadline = time.monotonic() + 60
    while not list(data.glob(".cluster.*")):
        assert busy.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    busy.kill()
    busy.wait()
    assert list(data.glob(".cluster.*"))
    with locked(data):
        assert [entry.name for entry in data.iterdir()] == [".lock"]


def test_workers_have_all_that_files_are_made_with() -> None:
    assert {name for name in made_with("encoding") if not name.startswith("recipe of")} <= setup().keys()


def test_a_missing_package_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = setup.__wrapped__()

    def without_vla_eval(name: str) -> str:
        if name == "vla-eval":
            raise PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(cluster_module, "version", without_vla_eval)
    assert setup.__wrapped__() == whole | {"vla-eval": "not installed"}


def test_replays_that_workers_leave_undone_are_named(tmp_path: Path) -> None:
    demos = DemosConfig(tasks=(f"{STOVE.suite}/{STOVE.name}",))
    rows = plan.make(demos.index().entries, CLEAN, ReplayConfig(), NONE)
    with pytest.raises(PipelineError, match="1 trajectories were replayed and are still missing") as caught:
        Replays(demos, ReplayConfig(), TrajectoryStore(tmp_path), lambda work, jobs, what: []).complete(rows)
    assert f"{rows[0].trajectory_id}.npz" in str(caught.value)
