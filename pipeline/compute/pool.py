"""One function behind which the work is spread: worker processes here or on a cluster, or a plain loop."""

from __future__ import annotations

import faulthandler
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Generic, Protocol, TypeVar

from pipeline.compute.cluster import Workplace, in_place, workplace_of
from pipeline.compute.progress import progress_of
from pipeline.compute.slurm import slurm_jobs
from pipeline.compute.workers import ended, local_cluster
from pipeline.compute_config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 30
"""How long to wait for a scheduler's answer."""

ALONE_S = 30
"""How long to wait for a worker where none is left."""

LOOK_S = 5
"""How often to look whether there are workers, while nothing gets done."""

LOST = "worker_lost"
"""Why an item was dropped that no worker survives, or that none finishes."""

TRIES = 2
"""After so many workers that ended over it, a piece of work is taken for their cause, and then tried as often alone."""


@dataclass(frozen=True)
class Expendable(Generic[Item, Result]):
    """A function of which one item may be given up, where no worker survives it or finishes it.

    Attributes:
        fn: the function.
        limit_s: so long an item may take; then it hangs, and its worker is ended. Far above what any takes.
        lost: called in the run's own process; what it returns takes the place of the item's result.
        size: how much of the work an item is, where items are not alike; progress is counted in it.
    """

    fn: Callable[[Item], Result]
    limit_s: Callable[[Item], float]
    lost: Callable[[Item], Result]
    size: Callable[[Item], int] = lambda item: 1

    def __call__(self, item: Item) -> Result:
        return self.fn(item)


class Workers(Protocol):
    """Apply ``fn`` to every item, in any order and place; the results come back in the order of the items.

    A worker that dies is replaced, and its item is done again. An item over which workers die again and again ends the
    run, unless ``fn`` is ``Expendable``.
    """

    def __call__(self, fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]: ...


def loop(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
    """Everything in this process, one after the other: for debugging and small jobs. What ends it ends the run."""
    sizes = _sizes(fn, items)
    with progress_of(description, sum(sizes)) as advance:
        results = []
        for item, size in zip(items, sizes, strict=True):
            results.append(fn(item))
            advance(size)
        return results


def _sizes(fn: Callable[[Item], Result], items: Sequence[Item]) -> list[int]:
    return [fn.size(item) if isinstance(fn, Expendable) else 1 for item in items]


@contextmanager
def runner(config: ComputeConfig, folder: Path, renders: bool = False) -> Iterator[Workers]:
    """Yield the function that runs work on what ``config.cluster`` names. Nothing is started before there is work.

    With the first work comes a ``PipelineError`` when no scheduler answers, or a worker cannot work for this run.

    Args:
        folder: what the work writes into; the workers of a cluster elsewhere must see it too.
        renders: whether the work does: local workers then render with what this process has chosen.
    """
    if config.cluster == "loop":
        yield loop
        return
    with ExitStack() as opened:
        workers: list[_Workers] = []

        def run(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
            if items and not workers:
                workers.append(opened.enter_context(_started(config, folder, renders)))
            return workers[0](fn, items, description) if items else []

        yield run


@contextmanager
def _started(config: ComputeConfig, folder: Path, renders: bool) -> Iterator[_Workers]:
    # One thread a worker process: GL contexts and the simulator are not shared, and OpenCV and NumPy would otherwise
    # each start a thread for every core in every worker. The environment is inherited by spawned workers.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    import dask
    from distributed import Client

    # What the scheduler of a cluster elsewhere does, its own settings say.
    dask.config.set(
        {
            "distributed.worker.multiprocessing-method": "spawn",
            # The profiler keeps the frames of the working thread, and with them open files and arrays, alive.
            "distributed.worker.profile.enabled": False,
            "distributed.admin.tick.limit": "60s",
            # The rows of 28,000 episodes, which the checks are sent, have 33 MB.
            "distributed.admin.large-graph-warning-threshold": "1GB",
            "distributed.scheduler.allowed-failures": TRIES - 1,
            "distributed.deploy.lost-worker-timeout": "5s",
        }
    )
    if config.cluster == "local":
        with local_cluster(config.workers, renders) as (client, refill):
            yield _Workers(client, refill=refill)
    elif config.cluster == "slurm":
        with slurm_jobs(config, folder) as jobs, Client(jobs.cluster) as client:
            jobs.wait_for_one(client)
            with workplace_of(client, folder) as workplace:
                # Jobs may wait in the queue for hours.
                yield _Workers(client, workplace, jobs.refill, patience_s=inf)
    else:
        try:
            client = Client(config.cluster, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise PipelineError(
                f"no Dask scheduler answers ({error})",
                where=config.cluster,
                remedy="start one, or set compute.cluster: local",
            ) from error
        with client, workplace_of(client, folder) as workplace:
            yield _Workers(client, workplace)


def _limited(fn: Expendable[Item, Result], item: Item) -> Result:
    """In a worker, whose process is ended when an item takes too long, also where it hangs in a library."""
    faulthandler.dump_traceback_later(fn.limit_s(item), exit=True)
    try:
        return fn(item)
    finally:
        faulthandler.cancel_dump_traceback_later()


@dataclass(frozen=True)
class _Workers:
    """Work on a client's workers.

    Attributes:
        client: of the cluster.
        workplace: what workers elsewhere have to have in common with the run.
        refill: brings back workers that are missing.
        patience_s: how long to wait for a worker where none is left.
    """

    client: Any
    workplace: Workplace | None = None
    refill: Callable[[], None] = lambda: None
    patience_s: float = ALONE_S

    def __call__(self, fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
        from distributed import KilledWorker

        limited = partial(_limited, fn) if isinstance(fn, Expendable) else fn
        work = limited if self.workplace is None else partial(in_place, limited, self.workplace)
        results: dict[int, Result] = {}
        deadly: list[int] = []
        sizes = _sizes(fn, items)
        with progress_of(description, sum(sizes)) as advance, closing(self._ended(work, items)) as outcomes:
            for number, outcome in outcomes:
                if isinstance(fn, Expendable) and isinstance(outcome, KilledWorker):
                    deadly.append(number)
                    continue
                results[number] = _result(outcome)
                advance(sizes[number])
            for number in deadly:
                # Alone now: another item may have ended the workers that this one waited on.
                ((_, outcome),) = self._ended(work, [items[number]])
                if isinstance(fn, Expendable) and isinstance(outcome, KilledWorker):
                    results[number] = fn.lost(items[number])
                else:
                    results[number] = _result(outcome)
                advance(sizes[number])
        return [results[number] for number in range(len(items))]

    def _ended(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Generator[tuple[int, Result | Exception]]:
        """The number of each item and its result or error, as they end."""
        from distributed import CancelledError, Future, KilledWorker

        # Not pure: equal items are still separate work, and the scheduler must not remember earlier runs.
        futures = self.client.map(work, items, pure=False)
        numbers = {future.key: number for number, future in enumerate(futures)}
        done: Queue[Future] = Queue()
        for future in futures:
            future.add_done_callback(done.put)
        try:
            while numbers:
                future = self._next(done)
                if future.status == "error":
                    yield numbers.pop(future.key), future.exception()
                    continue
                try:
                    result = future.result(timeout=ALONE_S)
                except TimeoutError:
                    # The worker that held it died, over another item, and so it is made again.
                    future.add_done_callback(done.put)
                    continue
                except KilledWorker as error:
                    yield numbers.pop(future.key), error
                    continue
                except (CancelledError, ConnectionError) as error:
                    raise self._lost("the Dask scheduler went away") from error
                yield numbers.pop(future.key), result
        finally:
            if self.client.status == "running":
                self.client.cancel([future for future in futures if future.key in numbers])

    def _next(self, done: Queue[Any]) -> Any:
        """The next future that is done.

        Raises:
            PipelineError: when nobody is left who could do one.
        """
        alone_s, last_came_s = 0, 0.0
        while True:
            try:
                return done.get(timeout=LOOK_S)
            except Empty:
                self.refill()
                workers, came_s = self._there()
                # A new worker may be on its way, or have come and died over its work.
                alone_s = 0 if workers or came_s > last_came_s else alone_s + LOOK_S
                last_came_s = came_s
                if alone_s >= self.patience_s:
                    raise self._lost(f"no worker is left, and none came in {self.patience_s} s") from None

    def _there(self) -> tuple[int, float]:
        """How many there are, and when the last of all came, by the scheduler's clock."""
        try:
            events = self.client.get_events("all")
            came_s = [stamp for stamp, event in events if event.get("action") == "add-worker"]
            return len(self.client.nthreads()), max(came_s, default=0.0)
        except (OSError, TimeoutError):  # no scheduler
            return 0, 0.0

    def _lost(self, what: str) -> PipelineError:
        return PipelineError(what, where=self.client.scheduler.address, remedy=f"start it again, and {GO_ON}")


def _result(outcome: Result | Exception) -> Result:
    """A result, or else the error raised, in words where workers died over an item."""
    from distributed import KilledWorker

    if isinstance(outcome, KilledWorker):
        what = f"one piece of work ended {outcome.allowed_failures + 1} workers"
        raise ended(what, f"the last was {outcome.last_worker.address}")
    if isinstance(outcome, Exception):
        raise outcome
    return outcome
