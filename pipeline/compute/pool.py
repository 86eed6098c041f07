"""Function that spreads work over worker processes on this machine or a cluster, or runs it in a plain loop."""

from __future__ import annotations

import faulthandler
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Generic, Protocol, TypeVar

from pipeline.compute.cluster import Workplace, in_place, workplace_of
from pipeline.compute.progress import progress_of
from pipeline.compute.slurm import slurm_jobs
from pipeline.compute.workers import local_cluster, lost_workers
from pipeline.compute_config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 30
"""Time to wait for a scheduler's answer."""

ALONE_S = 30
"""Time to wait for a worker if none is left."""

LOOK_S = 5
"""Time between two checks for workers."""

LOST = "worker_lost"
"""Reason of an item that was dropped because no worker survives or finishes it."""

TRIES = 2
"""Number of workers that end over an item before the item counts as the cause. It is then tried as often alone."""


class Job(ABC, Generic[Result]):
    """Item of work that may be given up if no worker survives or finishes it; ``run_job`` performs it."""

    @abstractmethod
    def __call__(self) -> Result:
        """Perform the job in a worker."""

    @abstractmethod
    def limit_s(self) -> float:
        """Return the time after which the job counts as hanging, in s; its worker is then ended.

        The limit is far above the time of any job.
        """

    @abstractmethod
    def lost(self) -> Result:
        """Return the result of a job that was given up; called in the run's own process."""

    def size(self) -> int:
        """Return the amount of work, in the unit of the progress bar."""
        return 1


def run_job(job: Job[Result]) -> Result:
    """Perform a job: the function that workers get together with jobs."""
    return job()


class Workers(Protocol):
    """Function that applies ``fn`` to every item, in any order and place, and returns results in the items' order.

    A worker that dies is replaced, and its item is repeated. An item over which workers die repeatedly ends the run,
    unless it is a ``Job``.
    """

    def __call__(self, fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]: ...


def loop(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
    """Run all items in this process, one after the other: for debugging and small jobs. A crash ends the run."""
    sizes = _sizes(items)
    with progress_of(description, sum(sizes)) as advance:
        results = []
        for item, size in zip(items, sizes, strict=True):
            results.append(fn(item))
            advance(size)
        return results


def _sizes(items: Sequence[object]) -> list[int]:
    return [item.size() if isinstance(item, Job) else 1 for item in items]


@contextmanager
def runner(compute_config: ComputeConfig, folder: Path, renders: bool = False) -> Iterator[Workers]:
    """Yield the function that runs work on the workers of ``compute_config.cluster``; they start with the first work.

    The first work raises a ``PipelineError`` if no scheduler answers, or a worker cannot work for this run.

    Args:
        folder: folder that the work writes into; the workers of an external cluster must see it too.
        renders: True if the work renders. Local workers then render with the device that this process has chosen.
    """
    if compute_config.cluster == "loop":
        yield loop
        return
    with ExitStack() as stack:
        workers: _DaskWorkers | None = None

        def run(fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
            nonlocal workers
            if not items:
                return []
            if workers is None:
                workers = stack.enter_context(_started(compute_config, folder, renders))
            return workers(fn, items, description)

        yield run


@contextmanager
def _started(compute_config: ComputeConfig, folder: Path, renders: bool) -> Iterator[_DaskWorkers]:
    import dask
    from distributed import Client

    # The scheduler of an external cluster has its own settings.
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
    if compute_config.cluster == "local":
        with local_cluster(compute_config.workers, renders) as (client, refill):
            yield _DaskWorkers(client, refill=refill)
    elif compute_config.cluster == "slurm":
        with slurm_jobs(compute_config, folder) as jobs, Client(jobs.cluster) as client:
            jobs.wait_for_one(client)
            with workplace_of(client, folder) as workplace:
                # Jobs may wait in the queue for hours.
                yield _DaskWorkers(client, workplace, jobs.refill, patience_s=inf)
    else:
        try:
            client = Client(compute_config.cluster, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise PipelineError(
                f"no Dask scheduler answers ({error})",
                where=compute_config.cluster,
                remedy="start a scheduler, or set compute.cluster: local",
            ) from error
        with client, workplace_of(client, folder) as workplace:
            yield _DaskWorkers(client, workplace)


def _call_with_limit(fn: Callable[[Item], Result], item: Item) -> Result:
    """Call ``fn`` in a worker, and end the worker's process if a job takes too long, even within a library."""
    if not isinstance(item, Job):
        return fn(item)
    faulthandler.dump_traceback_later(item.limit_s(), exit=True)
    try:
        return fn(item)
    finally:
        faulthandler.cancel_dump_traceback_later()


@dataclass(frozen=True)
class _DaskWorkers:
    """Work on a client's workers.

    Attributes:
        client: Dask client of the cluster.
        workplace: folders and setup that external workers must share with the run.
        refill: replaces missing workers.
        patience_s: time to wait for a worker if none is left.
    """

    client: Any
    workplace: Workplace | None = None
    refill: Callable[[], None] = lambda: None
    patience_s: float = ALONE_S

    def __call__(self, fn: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
        from distributed import KilledWorker

        work: Callable[[Item], Result] = partial(_call_with_limit, fn)
        if self.workplace is not None:
            work = partial(in_place, work, self.workplace)
        results: dict[int, Result] = {}
        killing_items: list[int] = []
        sizes = _sizes(items)
        with progress_of(description, sum(sizes)) as advance, closing(self._outcomes(work, items)) as outcomes:
            for number, outcome in outcomes:
                if isinstance(items[number], Job) and isinstance(outcome, KilledWorker):
                    killing_items.append(number)
                    continue
                results[number] = _result(outcome)
                advance(sizes[number])
            for number in killing_items:
                item = items[number]
                # Try it alone: another item may have ended the workers that had this item too.
                ((_, outcome),) = self._outcomes(work, [item])
                if isinstance(item, Job) and isinstance(outcome, KilledWorker):
                    results[number] = item.lost()
                else:
                    results[number] = _result(outcome)
                advance(sizes[number])
        return [results[number] for number in range(len(items))]

    def _outcomes(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Generator[tuple[int, Result | Exception]]:
        """Yield the number of each item and its result or error, in the order in which items end."""
        from distributed import CancelledError, Future, KilledWorker
        from distributed.comm import CommClosedError

        # Not pure: equal items are still separate work, and the scheduler must not remember earlier runs.
        futures = self.client.map(work, items, pure=False)
        numbers = {future.key: number for number, future in enumerate(futures)}
        done: Queue[Future] = Queue()
        for future in futures:
            future.add_done_callback(done.put)
        last_check_s = time.monotonic()
        try:
            while numbers:
                # While many workers work, items end all the time.
                if time.monotonic() - last_check_s >= LOOK_S:
                    self.refill()
                    last_check_s = time.monotonic()
                future = self._wait_for_next(done)
                if future.status == "error":
                    yield numbers.pop(future.key), future.exception()
                    continue
                try:
                    result = future.result(timeout=ALONE_S)
                except TimeoutError:
                    # The worker that held the result died over another item, so Dask computes the result again.
                    future.add_done_callback(done.put)
                    continue
                except KilledWorker as error:
                    yield numbers.pop(future.key), error
                    continue
                except (CancelledError, CommClosedError, ConnectionError) as error:
                    raise self._scheduler_error("the Dask scheduler no longer answers") from error
                # A worker that ends by itself would have to pass stored results on.
                future.release()
                yield numbers.pop(future.key), result
        finally:
            # A client whose scheduler has just died may still call itself running.
            if self.client.status == "running":
                with suppress(OSError):
                    self.client.cancel([future for future in futures if future.key in numbers])

    def _wait_for_next(self, done: Queue[Any]) -> Any:
        """Return the next future that is done.

        Raises:
            PipelineError: when no worker is left.
        """
        without_workers_s, earlier_connected_s = 0, 0.0
        while True:
            try:
                return done.get(timeout=LOOK_S)
            except Empty:
                self.refill()
                workers, last_connected_s = self._count_workers()
                # A new worker may be starting, or may have connected and died over its work.
                if workers or last_connected_s > earlier_connected_s:
                    without_workers_s = 0
                else:
                    without_workers_s += LOOK_S
                earlier_connected_s = last_connected_s
                if without_workers_s >= self.patience_s:
                    what = f"no worker is left, and no new worker connected within {self.patience_s} s"
                    raise self._scheduler_error(what) from None

    def _count_workers(self) -> tuple[int, float]:
        """Return the number of workers, and the time when the last worker connected, by the scheduler's clock."""
        try:
            events = self.client.get_events("all")
            connected_s = [stamp for stamp, event in events if event.get("action") == "add-worker"]
            return len(self.client.nthreads()), max(connected_s, default=0.0)
        except (OSError, TimeoutError):  # no scheduler
            return 0, 0.0

    def _scheduler_error(self, what: str) -> PipelineError:
        remedy = f"start the scheduler and its workers again, and {GO_ON}"
        return PipelineError(what, where=self.client.scheduler.address, remedy=remedy)


def _result(outcome: Result | Exception) -> Result:
    """Return a result, or raise the error. If workers died over the item, the raised error states this."""
    from distributed import KilledWorker

    if isinstance(outcome, KilledWorker):
        what = f"one item of work ended {outcome.allowed_failures + 1} workers"
        raise lost_workers(what, f"last worker {outcome.last_worker.address}")
    if isinstance(outcome, Exception):
        raise outcome
    return outcome
