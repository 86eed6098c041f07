"""Workers as jobs of a real SLURM, of one node, that runs as whoever runs the tests."""

import getpass
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import dask
import pytest
import yaml
from checkout import REPOSITORY
from distributed import Client
from pydantic import ValidationError

from pipeline.compute.pool import runner
from pipeline.compute.slurm import seconds_of, time_limit
from pipeline.compute_config import JOB_GB, ComputeConfig, SlurmConfig
from pipeline.config import load
from pipeline.errors import PipelineError
from pipeline.machine_code import machine_code
from pipeline.run.run import Run
from pipeline.validation import doctor

DEADLINE_S = 60.0

TWO_CORES = """
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmdPort={node_port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
StateSaveLocation={folder}
SlurmdSpoolDir={folder}/node
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=2000
PartitionName=cpu Nodes={host} Default=YES State=UP
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A SLURM that this process and its jobs find; the folder that its files are in."""
    folder = tmp_path / "slurm"
    (folder / "node").mkdir(parents=True)
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        port, node_port = one.getsockname()[1], other.getsockname()[1]
    host = socket.gethostname().split(".")[0]
    settings = TWO_CORES.format(host=host, port=port, node_port=node_port, user=getpass.getuser(), folder=folder)
    file = folder / "slurm.conf"
    file.write_text(settings)
    monkeypatch.setenv("SLURM_CONF", str(file))
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join(map(str, (REPOSITORY, REPOSITORY / "tests", REPOSITORY / "tests" / "compute")))
    )
    monkeypatch.setenv("PATH", "/usr/sbin", prepend=os.pathsep)
    with ExitStack() as stack:
        logs = stack.enter_context((folder / "slurm.log").open("w"))
        for daemon in ("slurmctld", "slurmd"):
            program = shutil.which(daemon)
            assert program is not None
            process = subprocess.Popen([program, "-D", "-f", str(file)], stdout=logs, stderr=logs)
            stack.callback(process.wait)
            stack.callback(process.terminate)
        deadline = time.monotonic() + DEADLINE_S
        while "idle" not in asked("sinfo", "-h", "-o", "%t"):
            assert time.monotonic() < deadline, (folder / "slurm.log").read_text()
            time.sleep(0.2)
        yield folder


def asked(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def job_of(item: int) -> tuple[int, str, str]:
    """In a worker: the item, the job that it runs in, how many threads that may start, and its machine code."""
    time.sleep(0.5)
    return item, os.environ["SLURM_JOB_ID"], f"{os.environ['LP_NUM_THREADS']} {machine_code()}"


@pytest.mark.slow
def test_the_work_is_done_by_jobs_of_slurm_and_again_where_one_is_ended(slurm: Path, tmp_path: Path) -> None:
    # A site may keep from jobs what importing this project has set where the run was started.
    options = ("--export=PATH,PYTHONPATH,SLURM_CONF",)
    asks = SlurmConfig(partition="cpu", memory_gb=0.9, options=options)
    compute = ComputeConfig(cluster="slurm", workers=2, slurm=asks)
    with runner(compute, tmp_path / "data") as work:
        first = work(job_of, range(6), "first")
        asked("scancel", first[0][1])
        second = work(job_of, range(6), "second")
    assert [item for item, _, _ in first] == [item for item, _, _ in second] == list(range(6))
    assert len({job for _, job, _ in first}) == 2
    assert {works_with for _, _, works_with in first} == {f"1 {machine_code()}"}
    ended = first[0][1]
    assert ended not in {job for _, job, _ in second}
    deadline = time.monotonic() + DEADLINE_S
    while queued := asked("squeue", "-h"):
        assert time.monotonic() < deadline, queued
        time.sleep(0.2)
    assert list((tmp_path / "data" / ".work" / "slurm").iterdir())


def job_of_long(item: int) -> tuple[int, str]:
    """Return in a worker, after some seconds, the item and the job that it runs in."""
    time.sleep(3)
    return item, os.environ["SLURM_JOB_ID"]


@pytest.mark.slow
def test_a_job_passes_its_work_on_before_its_walltime(
    slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a single try, an item whose worker SLURM ended would end the run."""
    monkeypatch.setattr("pipeline.compute.pool.TRIES", 1)
    compute = ComputeConfig(cluster="slurm", workers=2, slurm=SlurmConfig(memory_gb=0.9, walltime="1"))
    with runner(compute, tmp_path / "data") as work:
        done = work(job_of_long, range(40), "long")
    assert [item for item, _ in done] == list(range(40))
    assert len({job for _, job in done}) > 2


@pytest.mark.parametrize(
    ("walltime", "seconds"),
    [
        ("30", 1800),
        ("90:30", 5430),
        ("12:00:00", 43_200),
        ("2-12", 216_000),
        ("2-12:30", 217_800),
        ("1-00:00:05", 86_405),
        ("UNLIMITED", None),
        ("-1", None),
        ("None", None),
    ],
)
def test_a_walltime_is_read_as_slurm_reads_it(walltime: str, seconds: float | None) -> None:
    """By the time formats of sbatch's manual."""
    assert seconds_of(walltime) == seconds


def test_the_time_limit_is_that_of_the_last_further_option() -> None:
    assert time_limit(SlurmConfig(walltime="1")) == "1"
    assert time_limit(SlurmConfig(walltime="1", options=("--time=12:00:00", "--time-min=5"))) == "12:00:00"
    with site("job-extra-directives: ['-t 2-0']"):
        assert time_limit(SlurmConfig(walltime="1")) == "2-0"
        assert time_limit(SlurmConfig(options=("-t30",))) == "30"
    with site("job-directives-skip: ['-t']"):
        assert seconds_of(time_limit(SlurmConfig(walltime="1"))) is None


def scheduler_address(_: int) -> str:
    """Return in a worker the address that it is connected to."""
    from distributed import get_worker

    return str(get_worker().scheduler.address)


@pytest.mark.slow
def test_jobs_are_connected_by_a_certificate_that_only_this_user_reads(slurm: Path, tmp_path: Path) -> None:
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(memory_gb=0.9))
    logs = tmp_path / "data" / ".work" / "slurm"
    logs.mkdir(parents=True)
    (logs / ".dask-jobqueue.worker.key.of_a_killed_run").touch()
    with runner(compute, tmp_path / "data") as work:
        (address,) = work(scheduler_address, [0], "address")
        modes = {file.stat().st_mode & 0o777 for file in logs.glob(".dask-jobqueue.*")}
        with pytest.raises(OSError, match="in <TCP"), Client(address.replace("tls", "tcp"), timeout=5):
            pass
    assert address.startswith("tls://")
    assert modes == {0o600}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["my runs", "runs(1)", "o'brien", "run$HOME"])
def test_a_folder_that_a_job_s_script_cannot_name_is_rejected_by_doctor_and_run(name: str, tmp_path: Path) -> None:
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(memory_gb=0.9))
    folder = tmp_path / name
    with pytest.raises(PipelineError, match="contains a space") as caught, runner(compute, folder) as work:
        work(job_of, [0], "none")
    assert str(folder) in str(caught.value)
    config = load(REPOSITORY / "configs" / "starter.yaml")
    config = config.model_copy(update={"compute": compute, "folder": folder})
    diagnosis = {finding.name: finding for finding in doctor.check(Run(config), 0.001)}["SLURM"]
    assert diagnosis.status == "fail"
    assert diagnosis.remedy == "set folder to a path of letters, digits and any of _ . - /"


@pytest.mark.slow
def test_rejections_by_slurm_are_reported_in_its_words(slurm: Path, tmp_path: Path) -> None:
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(partition="nowhere"))
    with pytest.raises(PipelineError, match="invalid partition") as caught, runner(compute, tmp_path / "data") as work:
        work(job_of, [0], "none")
    assert "compute.slurm" in str(caught.value)


@pytest.mark.slow
def test_doctor_lets_slurm_check_the_job_and_submits_none(slurm: Path, tmp_path: Path) -> None:
    starter = load(REPOSITORY / "configs" / "starter.yaml")
    results = {}
    for partition in ("cpu", "nowhere"):
        compute = ComputeConfig(cluster="slurm", workers=2, slurm=SlurmConfig(partition=partition, memory_gb=1))
        config = starter.model_copy(update={"compute": compute, "folder": tmp_path})
        results[partition] = {finding.name: finding for finding in doctor.check(Run(config), 0.001)}["SLURM"]
    assert [results["cpu"].status, results["nowhere"].status] == ["ok", "fail"]
    assert "invalid partition" in results["nowhere"].detail
    assert asked("squeue", "-h", "--states=all") == ""


@contextmanager
def site(settings: str) -> Iterator[None]:
    """Apply what a site has in its ``jobqueue.yaml``."""
    import dask_jobqueue  # noqa: F401 - its defaults

    with dask.config.set({f"jobqueue.slurm.{name}": value for name, value in yaml.safe_load(settings).items()}):
        yield


def told_by_site(item: int) -> tuple[str, dict[str, float], str]:
    """In a worker: what the job's script exported, the worker's own options, and what SLURM knows of the job."""
    from distributed import get_worker

    job = asked("scontrol", "show", "job", os.environ["SLURM_JOB_ID"])
    return os.environ["SITE"], dict(get_worker().state.total_resources), job


@pytest.mark.slow
def test_settings_of_the_site_and_of_the_run_apply(slurm: Path, tmp_path: Path) -> None:
    settings = """
        job-extra-directives: ["--comment=of-the-site", "--time-min=1"]
        job-script-prologue: ["export SITE='module load'", "export LP_NUM_THREADS=7"]
        worker-extra-args: ["--resources", "licences=3"]
        scheduler-options: {host: 127.0.0.1, protocol: "tcp://"}
        job-mem: 700M
    """
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(options=("--comment=of-the-run",)))
    with site(settings), runner(compute, tmp_path / "data") as work:
        ((exported, resources, job),) = work(told_by_site, [0], "site")
        ((_, _, works_with),) = work(job_of, [0], "threads")
    assert (exported, resources) == ("module load", {"licences": 3.0})
    # Where both name an option, the run's decides.
    assert works_with.split()[0] == "1"
    assert "Comment=of-the-run" in job
    assert "MinMemoryNode=700M" in job


@pytest.mark.slow
def test_jobs_that_end_before_their_worker_starts_end_the_run(
    slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.compute.slurm.LOOK_S", 1)
    compute = ComputeConfig(cluster="slurm", workers=2, slurm=SlurmConfig(memory_gb=0.5))
    with (
        site("python: /removed/bin/python"),
        pytest.raises(PipelineError, match="4 jobs ended before their worker started") as caught,
        runner(compute, tmp_path / "data") as work,
    ):
        work(job_of, [0], "none")
    assert "/removed/bin/python: No such file or directory" in str(caught.value)
    assert str(tmp_path / "data" / ".work" / "slurm") in str(caught.value)
    assert not asked("squeue", "-h")


@pytest.mark.slow
def test_jobs_that_can_no_longer_start_end_the_run(
    slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first job works; what takes its place ends at once, as where the environment was removed meanwhile."""
    monkeypatch.setattr("pipeline.compute.pool.LOOK_S", 1)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(memory_gb=0.5))
    with site(f"python: {python}"), runner(compute, tmp_path / "data") as work:
        ((_, job, _),) = work(job_of, [0], "first")
        python.unlink()
        asked("scancel", job)
        with pytest.raises(PipelineError, match="2 jobs ended before their worker started"):
            work(job_of, [0], "second")


def test_a_job_has_the_memory_that_the_stages_were_measured_to_take() -> None:
    """By docs/cost.md: 4.6 GB, in ``validate`` of 1,004 episodes."""
    assert JOB_GB > 4.6


@pytest.mark.parametrize(
    ("compute", "expected"),
    [
        ({"cluster": "slurm"}, "needs a number of workers"),
        ({"cluster": "local", "slurm": {}}, "slurm requires cluster: slurm"),
        ({"cluster": "slurm", "workers": 2, "slurm": {"queue": "cpu"}}, "queue"),
    ],
)
def test_a_section_that_does_not_fit_is_rejected(compute: dict[str, object], expected: str) -> None:
    with pytest.raises(ValidationError, match=expected):
        ComputeConfig.model_validate(compute)
