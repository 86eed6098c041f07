"""Local workers: nothing listens beyond this machine, no stranger connects, and no profiler keeps frames."""

import re
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig


def addresses() -> list[str]:
    """List the addresses on which this process listens."""
    connections = psutil.Process().net_connections("inet")
    return [connection.laddr.ip for connection in connections if connection.status == psutil.CONN_LISTEN]


def look_around(wait_s: float) -> tuple[list[str], int]:
    """Work in a worker for a while, as long as a profiler takes for a hundred samples.

    Returns:
        Addresses on which the worker listens, and the number of samples that Dask's profiler has taken.
    """
    from distributed import worker_client

    time.sleep(wait_s)
    with worker_client() as client:
        return addresses(), client.profile()["count"]


@pytest.mark.slow
def test_local_workers_listen_on_this_machine_alone_and_are_not_profiled(tmp_path: Path) -> None:
    with runner(ComputeConfig(cluster="local", workers=2), tmp_path) as workers:
        results = workers(look_around, [1.2, 1.2], "look around")
        here = addresses()
    listening = [*here, *(address for found, _ in results for address in found)]
    assert len(listening) >= 4
    assert set(listening) == {"127.0.0.1"}
    assert [samples for _, samples in results] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_another_program_of_this_machine_cannot_run_code_in_the_workers(protocol: str, tmp_path: Path) -> None:
    """A second process knows the address, and neither the certificate nor the key of the run."""
    from distributed import get_client

    ran = tmp_path / "ran"
    with runner(ComputeConfig(cluster="local", workers=1), tmp_path) as workers:
        assert workers(abs, [-1], "start") == [1]
        address = get_client().scheduler.address.replace("tls", protocol)
        code = f"""
import pathlib
from distributed import Client, Security
security = Security() if {protocol!r} == "tcp" else Security.temporary()
with Client({address!r}, security=security, timeout=5) as client:
    client.run_on_scheduler(pathlib.Path({str(ran)!r}).touch)
"""
        stranger = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
        )
        assert workers(abs, [-1], "still there") == [1]
    assert not ran.exists()
    assert stranger.returncode != 0
    assert re.search("CommClosedError|OSError", stranger.stderr.splitlines()[-1]), stranger.stderr
