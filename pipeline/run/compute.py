"""One function behind which the work is spread: worker processes here, a Dask cluster elsewhere, or a plain loop."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pipeline.config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.run.cluster import InPlace, Workplace, joined

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 30
"""How long to wait for a scheduler's answer."""


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
        )
        with cluster, Client(cluster) as client:
            yield _on(client)
    else:
        try:
            client = Client(config.cluster, timeout=CONNECT_S)
        except OSError as error:
            raise PipelineError(
                "no Dask scheduler answers", where=config.cluster, remedy="start one, or set compute.cluster: local"
            ) from error
        with client, joined(client, folder) as workplace:
            yield _on(client, workplace)


def _on(client: Any, workplace: Workplace | None = None) -> Run:
    from distributed import as_completed

    def run(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
        # Not pure: equal items are still separate work, and the scheduler must not remember earlier runs.
        futures = client.map(fn if workplace is None else InPlace(fn, workplace), items, pure=False)
        with _progress(description, len(items)) as advance:
            for future in as_completed(futures):
                if future.status == "error":
                    error = future.exception()
                    client.cancel(futures)
                    raise error
                advance()
        return list(client.gather(futures))

    return run


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
