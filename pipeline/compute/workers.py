"""Starts workers: processes of this machine."""

import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON

STARTS = 2
"""How often workers are started, where they end before all have started."""


@contextmanager
def local_cluster(workers: int | None, renders: bool) -> Iterator[tuple[Any, Callable[[], None]]]:
    """A client of so many workers, one for each core when left out, and what brings back those that died.

    ``renders`` is that of ``runner``.

    Raises:
        PipelineError: when the workers end while they start.
    """
    from dask.system import CPU_COUNT
    from distributed import Client

    workers = workers or CPU_COUNT
    # So would software GL; where workers are fewer than cores, it uses the others.
    os.environ["LP_NUM_THREADS"] = str(max(1, CPU_COUNT // workers))
    with _ended(_started(workers)) as cluster, Client(cluster) as client:
        client.run(_leave_interrupts_to_the_run)
        if renders:
            _have_rendered_alike(client)
        # A worker that dies while it starts is not replaced by Dask alone.
        yield client, partial(cluster.scale, workers)


def _started(workers: int) -> Any:
    """Worker processes on this machine. Where one of them dies before all have started, Dask ends them; they are
    started once more."""
    from distributed import LocalCluster

    # An error reaches the user once, from here.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    for _ in range(STARTS):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                # No dashboard; Dask's health page stays on this machine, on a port that is free.
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                memory_limit=None,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            failure = error
    raise ended(f"worker processes ended while they started, {STARTS} times") from failure


def ended(what: str, where: str | None = None) -> PipelineError:
    """The error that workers ended, and nothing says why."""
    expected = "workers that live: the system may have ended them because memory ran out"
    return PipelineError(
        what, where=where, expected=expected, remedy=f"see the system's log, use fewer workers, and {GO_ON}"
    )


@contextmanager
def _ended(cluster: Any) -> Iterator[Any]:
    """End the workers. On a busy machine they may take longer than Dask waits: they then end with this process, and
    what they finished counts."""
    try:
        yield cluster
    finally:
        with suppress(TimeoutError):
            cluster.close()


def _have_rendered_alike(client: Any) -> None:
    """Have each worker of this machine render with what renders here, also those that come later."""
    from distributed import Worker, WorkerPlugin

    prepare = gl.WorkerSetup()

    class Prepared(WorkerPlugin):  # type: ignore[misc]
        def setup(self, worker: Worker) -> None:
            prepare(int(worker.name))

    client.register_plugin(Prepared())


def _leave_interrupts_to_the_run() -> None:
    """In a worker: Ctrl-C reaches all processes of a terminal, and the run ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
