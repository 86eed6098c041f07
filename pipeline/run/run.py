"""A run: one configuration, and the files in its folder ``data/<run>``."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from pipeline.compute.pool import Workers, runner
from pipeline.config import Config
from pipeline.files import Edition, edition
from pipeline.formats.base import AnyFormat
from pipeline.planning import plan
from pipeline.run import manifest, outcome
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.layout import FRAMES, MANIFEST, PLAN, REPORT, TRAJECTORIES, VALIDATION
from pipeline.run.outcome import Outcome
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore


class Run:
    """One run: its configuration, the paths in its folder, and the stored files.

    Stores and outcome are opened at first use, and kept. Plan and manifest are read again when their file has changed.
    Each stage or command gets its own ``Run``.
    """

    def __init__(self, config: Config, folder: Path | None = None) -> None:
        self.config = config
        self.folder = folder or config.run_folder

    def __reduce__(self) -> tuple[type["Run"], tuple[Config, Path]]:
        """Send only the configuration and the folder to a worker, which opens the stores itself."""
        return Run, (self.config, self.folder)

    def resolved(self) -> "Run":
        """Return this run with an absolute path, without links, for libraries that change or compare paths."""
        return Run(self.config, self.folder.resolve())

    def path(self, name: str) -> Path:
        """Return the path of a file or folder of the run, by one of the names of ``layout.py``."""
        return self.folder / name

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def plan_file(self) -> Path:
        return self.path(PLAN)

    @property
    def manifest_file(self) -> Path:
        return self.path(MANIFEST)

    @property
    def report_file(self) -> Path:
        return self.path(REPORT)

    @property
    def validation_file(self) -> Path:
        return self.path(VALIDATION)

    @cached_property
    def trajectories(self) -> TrajectoryStore:
        """Replayed trajectories."""
        return TrajectoryStore(self.path(TRAJECTORIES))

    @cached_property
    def frames(self) -> FrameStore:
        """Rendered frames."""
        return FrameStore(self.path(FRAMES), self.config.render)

    @property
    def plan(self) -> Sequence[plan.Row]:
        """Rows of the plan.

        Raises:
            PipelineError: when there is no plan, or it cannot be read.
        """
        return _plan(edition(self.plan_file)) if self.plan_file.exists() else plan.read(self.plan_file)

    @property
    def manifest(self) -> Sequence[dict[str, Any]]:
        """Rows of the manifest, not to be changed.

        Raises:
            PipelineError: when there is no manifest, or it cannot be read.
        """
        file = self.manifest_file
        return _manifest(edition(file)) if file.exists() else manifest.read(file)

    @cached_property
    def outcome(self) -> Outcome:
        """Plan and verdicts after the stage ``render``, with ``export.where`` applied.

        Raises:
            PipelineError: when a trajectory or a frame that the plan needs is missing or cannot be read.
        """
        return outcome.judge(self.plan, self.trajectories, self.frames, self.config)

    @property
    def datasets(self) -> list[AnyFormat]:
        """Datasets that the configuration requests."""
        return self.config.export.datasets(self.folder, self.config.render.content)

    def dataset(self, name: str) -> AnyFormat:
        """Return the dataset of a format that the configuration requests, such as ``rlds``."""
        (dataset,) = (dataset for dataset in self.datasets if dataset.name == name)
        return dataset

    @property
    def failure_datasets(self) -> list[AnyFormat]:
        """Datasets of failures that the configuration requests."""
        return self.config.export.failure_datasets(self.folder, self.config.render.content)

    @property
    def recorded_datasets(self) -> list[AnyFormat]:
        """Datasets that the configuration requests; datasets of failures only if they exist."""
        recorded_failures = [dataset for dataset in self.failure_datasets if dataset.record_file.exists()]
        return [*self.datasets, *recorded_failures]

    def episode_loader(
        self,
        *,
        failures: bool = False,
        rewrites: Mapping[str, Sequence[str]] | None = None,
        replays: bool = False,
    ) -> EpisodeLoader:
        """Return the loader of rendered episodes; for the arguments see ``EpisodeLoader``."""
        return EpisodeLoader(self.folder, self.config.render, failures, rewrites or {}, replays)

    def workers(self, *, renders: bool = False) -> AbstractContextManager[Workers]:
        """Start the workers of the section ``compute``, which stop when the context ends."""
        return runner(self.config.compute, self.folder, renders=renders)


@lru_cache(maxsize=1)
def _plan(file: Edition) -> list[plan.Row]:
    return plan.read(file.path)


@lru_cache(maxsize=1)
def _manifest(file: Edition) -> list[dict[str, Any]]:
    return manifest.read(file.path)
