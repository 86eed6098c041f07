"""The section ``compute`` of a configuration."""

from __future__ import annotations

from pydantic import Field, model_validator

from pipeline.axes.base import Frozen
from pipeline.types import Count

LARGEST_GB = 4.6
"""Most memory that a worker process has taken: in ``validate`` of 1,004 episodes of all 40 tasks (docs/cost.md)."""

JOB_GB = round(4 / 3 * LARGEST_GB)
"""Memory of a job of SLURM, which ends a job that takes more: a third above ``LARGEST_GB``."""


class SlurmConfig(Frozen):
    """Resources of each worker's SLURM job; fields that are left out have the value of the site's ``jobqueue.yaml``.

    Attributes:
        partition, account: of the site.
        walltime: after which SLURM ends a worker, such as ``"12:00:00"``; another worker repeats its work.
        memory_gb: of a worker; ``JOB_GB`` where neither this nor the site's ``job-mem`` is set.
        options: further options of ``sbatch``, such as ``--gres=gpu:1``, after the site's ``job-extra-directives``.
    """

    partition: str | None = None
    account: str | None = None
    walltime: str | None = None
    memory_gb: float | None = Field(default=None, gt=0.0, le=1000.0)
    options: tuple[str, ...] = ()


class ComputeConfig(Frozen):
    """Place of the computation; it never changes the result.

    Attributes:
        cluster: ``local`` starts worker processes here, ``loop`` runs everything in this process, ``slurm`` has SLURM
            start them, anything with ``://`` is the address of a Dask scheduler.
        workers: processes of a local cluster, one for each core when left out; or jobs of SLURM.
        slurm: what a job asks for.
    """

    cluster: str = Field(default="local", pattern=r"^(local|loop|slurm|\w+://.+)$")
    workers: Count | None = None
    slurm: SlurmConfig | None = None

    @model_validator(mode="after")
    def _slurm_with_slurm(self) -> ComputeConfig:
        if self.cluster == "slurm" and self.workers is None:
            raise ValueError("cluster: slurm needs a number of workers")
        if self.cluster != "slurm" and self.slurm is not None:
            raise ValueError("slurm goes with cluster: slurm, and only with it")
        return self
