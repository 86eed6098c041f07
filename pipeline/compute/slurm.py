"""Workers as SLURM jobs, which wait in SLURM's queue until resources are free."""

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.compute.workers import VARIABLES
from pipeline.compute_config import JOB_GB, ComputeConfig, SlurmConfig
from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON
from pipeline.machine_code import MACHINE_CODE_VARIABLES, in_shell

LOGS = Path(".work") / "slurm"
"""Folder, below the run's, of the jobs' output."""

STARTS = 2
"""Number of jobs that may end before their worker starts, as a multiple of the number of workers."""

LOOK_S = 5
"""Time between two checks of the queue while no worker has started."""

END_S = 300
"""Mean time before its walltime, or half of a shorter walltime, at which a worker passes its work on and ends."""

_TIME = re.compile(r"(?:--time[= ]|-t[= ]?)\s*(.+)")
"""Option of sbatch that sets the time limit."""

LINES_SHOWN = 8
"""Number of last lines of a job's output in an error."""


@dataclass
class SlurmJobs:
    """The jobs of a cluster, one for each worker.

    Attributes:
        cluster: a ``SLURMCluster``.
        workers: number of workers that are wanted.
        logs: folder of the jobs' output.
        started: ids of the jobs whose worker has connected to the scheduler.
        in_vain: number of jobs that ended before their worker started, since the last start of a worker.
    """

    cluster: Any
    workers: int
    logs: Path
    started: set[str] = field(default_factory=set)
    in_vain: int = 0

    def wait_for_one(self, client: Any) -> None:
        """Wait until a worker has connected, for as long as a job is in the queue.

        Raises:
            PipelineError: if every job has ended.
        """
        while True:
            with suppress(TimeoutError):
                client.wait_for_workers(1, timeout=LOOK_S)
                return
            self.refill()

    def refill(self) -> None:
        """Submit a job for each job that has ended.

        Raises:
            PipelineError: if every job has ended, and ``STARTS`` times as many as wanted ended before their worker
                started.
        """
        connected = {worker["name"] for worker in self.cluster.scheduler_info["workers"].values()}
        # Dask gives the job that replaces another one the same name.
        jobs = {name: job.job_id for name, job in dict(self.cluster.workers).items()}
        started = {job_id for name, job_id in jobs.items() if name in connected}
        if started - self.started:
            self.started |= started
            self.in_vain = 0
        queued = _queued()
        if queued is None:
            return
        # Dask replaces workers that were connected; it does not notice a job that ends before.
        ended = {name: job_id for name, job_id in jobs.items() if job_id not in self.started | queued}
        if self.in_vain + len(ended) < STARTS * self.workers:
            if ended:
                self.in_vain += len(ended)
                print(f"{len(ended)} SLURM jobs ended before their worker started: see {self.logs}", file=sys.stderr)
                self.cluster.sync(self.cluster.scale_down, list(ended))
            self.cluster.scale(self.workers)
        elif not connected and len(ended) == len(jobs):
            raise self._failed(ended)

    def _failed(self, ended: Mapping[str, str | None]) -> PipelineError:
        last = max((job_id for job_id in ended.values() if job_id), key=int, default=None)
        if last is None:
            what = "sbatch submitted no job"
        else:
            what = f"{self.in_vain + len(ended)} jobs ended before their worker started; the last lines of job {last}:"
        return PipelineError(
            "\n".join([what, *self._last_lines(last)]),
            where=self.logs,
            expected="jobs in which `dask worker` starts and connects to this machine",
            remedy=f"correct compute.slurm or the site's jobqueue.yaml, and {GO_ON}",
        )

    def _last_lines(self, job_id: str | None) -> list[str]:
        lines: list[str] = []
        for log in sorted(self.logs.glob(f"*-{job_id}.*")):
            lines += log.read_text(errors="replace").splitlines()
        return [line for line in lines if line.strip()][-LINES_SHOWN:]


@contextmanager
def slurm_jobs(compute_config: ComputeConfig, folder: Path) -> Iterator[SlurmJobs]:
    """Start a scheduler in this process and submit a job for each worker; cancel the jobs when the block ends.

    The site's settings in ``jobqueue.yaml`` apply. Our lists are appended to the site's lists, so that ours decide if
    both name the same option.

    Args:
        compute_config: section with ``cluster: slurm``.
        folder: folder that the work writes into; the nodes must see it too.

    Raises:
        PipelineError: if SLURM rejects the job, or the path of the folder needs quotes.
    """
    _reject_unquoted(folder)
    logs = (folder / LOGS).absolute()
    workers = compute_config.workers or 1
    for left_by_a_kill in logs.glob(".dask-jobqueue.worker.*"):
        left_by_a_kill.unlink()
    # Jobs read a certificate of this run in its folder. Programs without it cannot run code in the workers.
    with _cluster(compute_config, logs, security=True, shared_temp_directory=str(logs)) as cluster:
        _try(cluster.job_script())
        cluster.scale(workers)
        print(f"{workers} jobs wait in SLURM's queue; their output is in {logs}", file=sys.stderr)
        yield SlurmJobs(cluster, workers, logs)


def check_job(compute_config: ComputeConfig, folder: Path) -> None:
    """Ask SLURM to check the job of a worker, without submitting it.

    Args:
        compute_config: section with ``cluster: slurm``.
        folder: folder that the work would write into.

    Raises:
        PipelineError: if SLURM rejects the job or is not installed, or if the path of the folder needs
            quotes.
    """
    _reject_unquoted(folder)
    with TemporaryDirectory() as logs, _cluster(compute_config, Path(logs)) as cluster:
        _try(cluster.job_script())


def _reject_unquoted(folder: Path) -> None:
    """Raise a ``PipelineError`` for a path that a shell would change, as dask-jobqueue does not quote it in a job."""
    path = str(folder.absolute())
    if quote(path) != path:
        raise PipelineError(
            "the path of the run's folder contains a space or another character that a SLURM job's script cannot have",
            where=path,
            remedy="set folder to a path of letters, digits and any of _ . - /",
        )


def _cluster(compute_config: ComputeConfig, logs: Path, **security: Any) -> Any:
    """Return a ``SLURMCluster`` without jobs, a context in which its scheduler runs.

    Args:
        compute_config: section with ``cluster: slurm``.
        logs: folder of the jobs' output.
        security: arguments of ``SLURMCluster`` about certificates.
    """
    import dask
    from dask_jobqueue.slurm import SLURMCluster

    job = compute_config.slurm or SlurmConfig()
    logs.mkdir(parents=True, exist_ok=True)
    # A site may keep the environment of the submitting process from its jobs.
    environment = f"export {in_shell(MACHINE_CODE_VARIABLES | VARIABLES | {'LP_NUM_THREADS': '1'})}"
    return SLURMCluster(
        cores=1,
        processes=1,
        memory=f"{JOB_GB}GB",
        job_mem=None if job.memory_gb is None else f"{ceil(job.memory_gb * 1e9 / 2**20)}M",
        queue=job.partition,
        account=job.account,
        walltime=job.walltime,
        job_extra_directives=_further_options(job),
        job_script_prologue=[*_of_site("job-script-prologue", "env-extra"), environment],
        log_directory=str(logs),
        python=dask.config.get("jobqueue.slurm.python", None) or quote(sys.executable),
        # SLURM limits memory itself.
        worker_extra_args=[*_lifetime(job), *_of_site("worker-extra-args", "extra"), "--memory-limit", "0"],
        scheduler_options={"dashboard_address": "127.0.0.1:0", **_scheduler_of_site()},
        **security,
    )


def _lifetime(job: SlurmConfig) -> list[str]:
    """Return options by which a worker ends before SLURM ends its job.

    Dask counts the end of a job against the item in work, as if the item had crashed the worker. A worker that ends by
    itself passes its work on. The times of the workers differ, so that not all of them end at once.
    """
    walltime_s = seconds_of(time_limit(job))
    if walltime_s is None:
        return []
    before_s = min(END_S, walltime_s / 2)
    return ["--lifetime", f"{walltime_s - before_s:.0f}s", "--lifetime-stagger", f"{0.8 * before_s:.0f}s"]


def time_limit(job: SlurmConfig) -> str:
    """Return the time limit of a job: of the last further option that sets it, else ``walltime``; or no number.

    dask-jobqueue writes further options after ``walltime``, and sbatch uses the last one.
    """
    import dask

    for option in reversed(_further_options(job)):
        stated = _TIME.fullmatch(option.strip())
        if stated:
            return stated[1]
    if "-t" in _of_site("job-directives-skip", "header-skip"):
        return "none"
    return str(job.walltime or dask.config.get("jobqueue.slurm.walltime", None))


def seconds_of(walltime: str) -> float | None:
    """Return a time limit as SLURM reads it, such as ``30``, ``12:00:00`` or ``2-12``; `None` for no limit."""
    days, dash, clock = walltime.rpartition("-")
    parts = clock.split(":")
    if dash and not days:  # SLURM reads -1 as no limit.
        return None
    if not all(part.isdecimal() for part in (*parts, days or "0")) or len(parts) > 3:
        return None
    first_unit = 0 if dash or len(parts) == 3 else 1
    units_s = (3600, 60, 1)[first_unit:]
    return 86400.0 * int(days or 0) + sum(unit_s * int(part) for unit_s, part in zip(units_s, parts, strict=False))


def _further_options(job: SlurmConfig) -> list[str]:
    """List the options of ``sbatch`` that the site and the run add."""
    return [*_of_site("job-extra-directives", "job-extra"), *job.options]


def _of_site(name: str, former_name: str) -> list[str]:
    """Read a list of the section ``slurm`` of ``jobqueue.yaml``, also under the name of earlier versions."""
    import dask

    for each in (name, former_name):
        values = dask.config.get(f"jobqueue.slurm.{each}", None)
        if values:
            return [str(value) for value in values]
    return []


def _scheduler_of_site() -> dict[str, Any]:
    import dask

    options = dict(dask.config.get("jobqueue.slurm.scheduler-options", None) or {})
    options.pop("protocol", None)  # certificates need TLS
    return options


def _queued() -> set[str] | None:
    """List the ids of the user's jobs that wait or run; `None` if SLURM does not answer."""
    answer = subprocess.run(
        ["squeue", "--me", "--noheader", "--format=%i"], capture_output=True, text=True, check=False
    )
    return set(answer.stdout.split()) if answer.returncode == 0 else None


def _try(script: str) -> None:
    """Ask SLURM to check a job without submitting it.

    Raises:
        PipelineError: if SLURM rejects it, in SLURM's words.
    """
    try:
        answer = subprocess.run(["sbatch", "--test-only"], input=script, capture_output=True, text=True, check=False)
        rejection = answer.stderr.strip() if answer.returncode else ""
    except FileNotFoundError as error:
        rejection = str(error)
    if rejection:
        raise PipelineError(
            f"SLURM rejects the job ({rejection})",
            where="sbatch",
            expected="a machine that can submit SLURM jobs, and options that SLURM knows",
            remedy="correct compute.slurm, or set compute.cluster: local",
        )
