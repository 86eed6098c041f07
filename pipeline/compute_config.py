"""The section ``compute`` of a configuration."""

from __future__ import annotations

from pydantic import Field, model_validator

from pipeline.types import Count, Frozen

USUAL_GB = 3.5
"""Memory of a worker process in usual runs: 2.5 GB in ``validate`` of the default run, and more in larger runs."""

LARGEST_GB = 4.6
"""Largest measured memory of a worker process.

An earlier version needed it in ``validate`` of 1,004 episodes of all 40 tasks (docs/cost.md).
"""

JOB_GB = round(4 / 3 * LARGEST_GB)
"""Memory of a SLURM job, a third above ``LARGEST_GB``. SLURM ends a job that takes more."""


class SlurmConfig(Frozen):
    """Resources of each worker's SLURM job. Omitted fields have the values of the site's ``jobqueue.yaml``.

    Attributes:
        partition: Partition of the site; by default the site's own setting.
        account: Account of the site; by default the site's own setting.
        walltime: Time limit of a worker's job, such as ``"12:00:00"``; by default the site's own setting. The worker
            ends some minutes before, and another worker repeats its unfinished work.
        memory_gb: Memory of a worker in GB; by default the site's ``job-mem``, or 6 GB without it.
        options: Further options of ``sbatch``, such as ``--gres=gpu:1``, added to the site's ``job-extra-directives``;
            none by default.
    """

    partition: str | None = None
    account: str | None = None
    walltime: str | None = None
    memory_gb: float | None = Field(default=None, gt=0.0, le=1000.0)
    options: tuple[str, ...] = ()


class ComputeConfig(Frozen):
    """Place of the computation, which never changes the result.

    Attributes:
        cluster: ``local`` starts worker processes on this machine, and ``loop`` computes in a single process.
            ``slurm`` starts each worker as a SLURM job. An address with ``://`` is a running Dask scheduler.
        workers: Number of worker processes; by default one for each core. ``slurm`` requires it, as the number of jobs.
        slurm: Resources of each SLURM job, only with ``cluster: slurm``; by default the site's own settings.
    """

    cluster: str = Field(default="local", pattern=r"^(local|loop|slurm|\w+://.+)$")
    workers: Count | None = None
    slurm: SlurmConfig | None = None

    @model_validator(mode="after")
    def _slurm_with_slurm(self) -> ComputeConfig:
        if self.cluster == "slurm" and self.workers is None:
            raise ValueError("cluster: slurm needs a number of workers")
        if self.cluster != "slurm" and self.slurm is not None:
            raise ValueError("the section slurm requires cluster: slurm")
        return self
