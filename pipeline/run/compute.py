"""One function behind which the work is spread: worker processes here, a Dask cluster elsewhere, or a plain loop."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pipeline.config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON
from pipeline.run.cluster import InPlace, Workplace, joined

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 30
"""How long to wait for a scheduler's answer."""

ALONE_S = 30
"""How long to wait for a worker where none is left."""

LOOK_S = 5
"""How often to look whether there are workers, while nothing gets done."""


class Run(Protocol):
    """Apply ``fn`` to every item, in any order and place; the results come back in the order of the items."""

    def __call__(self, fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]: ...


def loop(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
    """Everything in this process, one after the other: for debugging and small jobs."""
    with _progress(description, len(items)) as advance:
        results = []
        for item in items:
            results.append(fn(item))
            advance()
        return results


@contextmanager
def runner(config: ComputeConfig, folder: Path) -> Iterator[Run]:
    """Open what ``config.cluster`` names and yield the function that runs work on it.

    Args:
        config: where to run.
        folder: what the work writes into; the workers of a cluster elsewhere must see it too.

    Raises:
        PipelineError: when no scheduler answers, or a worker cannot work for this run.
    """
    if config.cluster == "loop":
        yield loop
        return
    # One thread a worker process: GL contexts and the simulator are not shared, and software GL and OpenCV would
    # otherwise each start a thread for every core in every worker. The environment is inherited by spawned workers.
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster

    if config.cluster == "local":
        dask.config.set({"distributed.worker.multiprocessing-method": "spawn", "distributed.admin.tick.limit": "60s"})
        cluster = LocalCluster(
            n_workers=config.workers or CPU_COUNT,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            memory_limit=None,
            # An error reaches the user once, from here.
            silence_logs=logging.CRITICAL,
        )
        with cluster, Client(cluster) as client:
            client.run(_leave_interrupts_to_the_run)
            yield _on(client)
    else:
        try:
            client = Client(config.cluster, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise PipelineError(
                f"no Dask scheduler answers ({error})",
                where=config.cluster,
                remedy="start one, or set compute.cluster: local",
            ) from error
        with client, joined(client, folder) as workplace:
            yield _on(client, workplace)


def _leave_interrupts_to_the_run() -> None:
    """In a worker: Ctrl-C reaches all processes of a terminal, and the run ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on(client: Any, workplace: Workplace | None = None) -> Run:
    from distributed import Future, KilledWorker

    def run(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
        # Not pure: equal items are still separate work, and the scheduler must not remember earlier runs.
        futures = client.map(fn if workplace is None else InPlace(fn, workplace), items, pure=False)
        done: Queue[Future] = Queue()
        for future in futures:
            future.add_done_callback(done.put)
        with _progress(description, len(items)) as advance:
            for _ in futures:
                future = _next(done, client)
                if future.status == "error":
                    error = future.exception()
                    client.cancel(futures)
                    raise _killed(error) if isinstance(error, KilledWorker) else error
                if future.status != "finished":
                    raise _lost(client, "the Dask scheduler went away")
                advance()
        return list(client.gather(futures))

    return run


def _next(done: Queue[Any], client: Any) -> Any:
    """The next future that is done.

    Raises:
        PipelineError: when nobody is left who could do one.
    """
    alone_s = 0
    while True:
        try:
            return done.get(timeout=LOOK_S)
        except Empty:
            # A new worker may be on its way, in place of one that died.
            alone_s = 0 if _has_workers(client) else alone_s + LOOK_S
            if alone_s >= ALONE_S:
                raise _lost(client, f"no worker is left, and none came in {ALONE_S} s") from None


def _has_workers(client: Any) -> bool:
    try:
        return bool(client.nthreads())
    except (OSError, TimeoutError):  # no scheduler
        return False


def _lost(client: Any, what: str) -> PipelineError:
    return PipelineError(what, where=client.scheduler.address, remedy=f"start it again, and {GO_ON}")


def _killed(error: Any) -> PipelineError:
    return PipelineError(
        f"one piece of work ended {error.allowed_failures + 1} workers, the last on {error.last_worker.address}",
        expected="workers that live: the system may have ended them because memory ran out",
        remedy=f"see the system's log, use fewer workers, and {GO_ON}",
    )


@contextmanager
def _progress(description: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar with rate and ETA on a terminal; a line every tenth of the way where there is none."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("elapsed"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=total, rate="")
        marks = {round(total * tenth / 10) for tenth in range(1, 11)}

        def advance() -> None:
            progress.advance(task)
            state = progress.tasks[task]
            done = int(state.completed)
            rate = done / max(state.elapsed or 0.0, 1e-9)
            progress.update(task, rate=f"{rate:.2f}/s")
            if not console.is_terminal and done in marks:
                left = (total - done) / rate
                console.print(f"{description}: {done}/{total}, {rate:.2f}/s, {left:.0f} s left", highlight=False)

        yield advance
