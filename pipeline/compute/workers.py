"""Start of workers as processes of this machine."""

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

VARIABLES = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
    "MALLOC_MMAP_THRESHOLD_": str(256 << 10),
    "__GL_YIELD": "USLEEP",
}
"""Environment variables of a worker process, which it inherits; Dask's own values give way to them.

A worker has one thread, as GL contexts and the simulator are not shared, but OpenCV and NumPy would start a thread for
every core. Dask makes glibc return every 64 KB that are free to the system. In software rendering, each frame may then
request thousands of pages again, up to a tenth of a worker's time. Blocks of 256 KB and more are returned at once: the
compilation of a scene frees 100 MB of them, and a frame of 256 pixels is smaller. While workers wait for a GPU that
they share, NVIDIA's OpenGL driver for Linux keeps their cores busy, unless ``__GL_YIELD`` makes it sleep
(``benchmarks/LOG.md``).
"""

STARTS = 2
"""Number of attempts to start the workers, if they end before all have started."""


@contextmanager
def local_cluster(workers: int | None, renders: bool) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Yield a client of workers on this machine, and a function that replaces workers that died.

    Args:
        workers: number of workers; one for each core if `None`.
        renders: True if the work renders, see ``runner``.

    Raises:
        PipelineError: when the workers end while they start.
    """
    from dask.system import CPU_COUNT
    from distributed import Client

    workers = workers or CPU_COUNT
    os.environ.update(VARIABLES)
    # Software GL would also start a thread for every core; with fewer workers than cores, it uses the remaining cores.
    os.environ["LP_NUM_THREADS"] = str(max(1, CPU_COUNT // workers))
    with _closing(_started(workers)) as cluster, Client(cluster) as client:
        client.run(_leave_interrupts_to_the_run)
        if renders:
            _have_rendered_alike(client, workers)
        # Dask does not replace a worker that dies while it starts.
        yield client, partial(cluster.scale, workers)


def _started(workers: int) -> Any:
    """Start worker processes on this machine.

    If a process dies before all have started, Dask ends all of them; they are then started again, ``STARTS`` times in
    all.
    """
    from distributed import LocalCluster

    # Errors are reported once, by the exception below.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    for _ in range(STARTS):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                # The dashboard is off; Dask's health page stays on this machine, on a free port.
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                memory_limit=None,
                # A certificate of this run keeps other users of this machine from running code in the workers.
                security=True,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            failure = error
    raise lost_workers(f"worker processes ended while they started, {STARTS} times") from failure


def lost_workers(what: str, where: str | None = None) -> PipelineError:
    """Return the error for workers that ended for an unknown reason."""
    expected = "workers that finish their work; the system may have ended them because memory ran out"
    remedy = f"read the system's log, reduce compute.workers, and {GO_ON}"
    return PipelineError(what, where=where, expected=expected, remedy=remedy)


@contextmanager
def _closing(cluster: Any) -> Iterator[Any]:
    """End the workers when the block ends.

    On a busy machine they may take longer than Dask waits. They then end with this process, and their finished work
    counts.
    """
    try:
        yield cluster
    finally:
        with suppress(TimeoutError):
            cluster.close()


def _have_rendered_alike(client: Any, workers: int) -> None:
    """Make each of the workers of this machine, later ones included, render with the device of this process."""
    from distributed import Worker, WorkerPlugin

    prepare = gl.WorkerSetup(workers)

    class Prepared(WorkerPlugin):  # type: ignore[misc]
        def setup(self, worker: Worker) -> None:
            prepare(int(worker.name))

    client.register_plugin(Prepared())


def _leave_interrupts_to_the_run() -> None:
    """Ignore Ctrl-C in a worker: it reaches all processes of a terminal, and the run ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
