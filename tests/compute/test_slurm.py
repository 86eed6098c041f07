"""Workers as jobs of a real SLURM, of one node, that runs as whoever runs the tests."""

import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from conftest import REPOSITORY
from pydantic import ValidationError

from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig, SlurmConfig
from pipeline.errors import PipelineError
from pipeline.machine_code import machine_code

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


@pytest.mark.slow
def test_what_slurm_refuses_is_said_in_its_words(slurm: Path, tmp_path: Path) -> None:
    compute = ComputeConfig(cluster="slurm", workers=1, slurm=SlurmConfig(partition="nowhere"))
    with pytest.raises(PipelineError, match="invalid partition") as caught, runner(compute, tmp_path / "data") as work:
        work(job_of, [0], "none")
    assert "compute.slurm" in str(caught.value)


@pytest.mark.parametrize(
    ("compute", "expected"),
    [
        ({"cluster": "slurm"}, "needs a number of workers"),
        ({"cluster": "local", "slurm": {}}, "goes with cluster: slurm"),
        ({"cluster": "slurm", "workers": 2, "slurm": {"queue": "cpu"}}, "queue"),
    ],
)
def test_a_section_that_does_not_fit_is_refused(compute: dict[str, object], expected: str) -> None:
    with pytest.raises(ValidationError, match=expected):
        ComputeConfig.model_validate(compute)
