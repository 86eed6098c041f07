"""Local workers: nothing listens beyond this machine, and no profiler keeps the frames of the work."""

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
