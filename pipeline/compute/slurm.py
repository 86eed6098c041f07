"""Workers as jobs of SLURM, which sit in its queue until it has room."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.config import ComputeConfig, SlurmConfig
from pipeline.errors import PipelineError
from pipeline.machine_code import SETTINGS, in_shell

LOGS = Path(".work") / "slurm"
"""Where a run's folder keeps what the jobs print."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")


@contextmanager
def slurm_cluster(config: ComputeConfig, folder: Path) -> Iterator[Any]:
    """A scheduler in this process and a job for each worker; when the block ends, so do the jobs.

    What a site needs beyond ``SlurmConfig``, such as the network interface, dask-jobqueue reads from its own file,
    ``~/.config/dask/jobqueue.yaml``. PipelineError when SLURM takes no job.

    Args:
        config: with ``cluster: slurm``.
        folder: what the work writes into; the nodes must see it too.
    """
    from dask_jobqueue.slurm import SLURMCluster

    job = config.slurm or SlurmConfig()
    logs = (folder / LOGS).absolute()
    logs.mkdir(parents=True, exist_ok=True)
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        memory=f"{job.memory_gb}GB",
        queue=job.partition,
        account=job.account,
        walltime=job.walltime,
        job_extra_directives=list(job.options),
        # Not every site hands on the environment that a job is asked for in.
        job_script_prologue=[f"export {in_shell(SETTINGS | dict.fromkeys(ONE_THREAD, '1'))}"],
        log_directory=str(logs),
        # SLURM watches memory itself.
        worker_extra_args=["--memory-limit", "0"],
        scheduler_options={"dashboard_address": ":0"},
    )
    with cluster:
        _try(cluster.job_script())
        cluster.scale(config.workers)
        print(f"{config.workers} jobs wait in SLURM's queue; what they print is in {logs}", file=sys.stderr)
        yield cluster


def _try(script: str) -> None:
    """Have SLURM look at a job without starting it: Dask would wait for ever for one that is refused. PipelineError in
    SLURM's words."""
    try:
        looked = subprocess.run(["sbatch", "--test-only"], input=script, capture_output=True, text=True, check=False)
        refusal = looked.stderr.strip() if looked.returncode else ""
    except FileNotFoundError as error:
        refusal = str(error)
    if refusal:
        raise PipelineError(
            f"takes no job ({refusal})",
            where="sbatch",
            expected="a machine from which SLURM's jobs can be started, and options that it knows",
            remedy="mend compute.slurm, or set compute.cluster: local",
        )
