"""Episodes for the training of an arm, from demonstrations to small frames in one file."""

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
from experiment import Experiment
from numpy.typing import NDArray
from sentences import Vectors, vector

from pipeline.axes import axes_of
from pipeline.compute.pool import Workers, runner
from pipeline.config import PlanConfig
from pipeline.episode_schema import STANDARD
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.images.jpeg import decode, resized
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import leakage, plan, selection
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.layout import FRAMES, PLAN, TRAJECTORIES
from pipeline.run.progress import rejections
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.run.verdicts import verdicts_of
from pipeline.stores.frame_store import FrameStore, frames_by_trajectory
from pipeline.stores.store import SUFFIX
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark

VIEWS = ("image", "wrist_image")
COLUMNS = ("episode_id", "demo_id", "task", "axis", "component", "level", "instruction")
"""Columns of the plan that are kept for each episode."""


@dataclass(frozen=True)
class Dataset:
    """Steps of an arm's episodes, one episode after the other.

    Attributes:
        images: view to (N, P, P, 3) uint8 RGB.
        state: (N, 8), action: (N, 7) float32.
        lengths: (E,) steps of each episode.
        episodes: E rows of ``COLUMNS``.
    """

    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    lengths: NDArray[np.int64]
    episodes: list[dict[str, Any]]

    def axes(self) -> dict[str, int]:
        """Count the episodes of each axis or combination."""
        return dict(sorted(Counter(row["axis"] for row in self.episodes).items()))


def make(experiment: Experiment, arm: str, demos: Sequence[DemoEntry], vectors: Vectors, file: Path) -> None:
    """Plan, replay and render only an arm's episodes, and write them.

    A stopped command resumes: its replays and frames are kept next to the file, and used by other arms.

    Raises:
        PipelineError: before any replay, if there are too few demonstrations, a perturbation is too near to a test
            task, or a sentence has no embedding. Before any rendering, if fewer episodes than wanted are kept.
    """
    rows, chosen = planned(experiment, arm, demos)
    for row in chosen:
        vector(row.instruction, vectors)
    leakage.reject_overlap(leakage.check(rows, benchmark.load()))
    folder, run = file.with_suffix(""), experiment.run
    folder.mkdir(parents=True, exist_ok=True)
    plan.write(rows, folder / PLAN)
    _link_files_of_other_arms(folder)
    frames, trajectories = FrameStore(folder / FRAMES, run.render), TrajectoryStore(folder / TRAJECTORIES)
    with runner(run.compute, folder, renders=True) as workers:
        rejected: dict[str, str] | None = None
        while (rejected_now := rejections(rows, frames_by_trajectory(frames.rows()), STANDARD.views)) != rejected:
            rejected = rejected_now
            Replays(run.demos, run.replay, trajectories, workers, run.filter).complete(rows, rejected)
            outcome = selection.select(chosen, verdicts_of(trajectories.rows(), chosen, run.filter), rejected)
            kept = [row for row in chosen if outcome[row.episode_id].kept]
            wanted = experiment.episodes_of(arm)
            if len(kept) < wanted:
                counts = Counter(row.axis for row in chosen if row.wanted) - Counter(row.axis for row in kept)
                raise PipelineError(
                    f"{len(kept)} of {wanted} episodes of {arm} are kept; missing are {dict(counts)}",
                    where=experiment.data,
                    expected="an equal number in all arms",
                    remedy="raise plan.reserve for perturbed episodes, or spare in the experiment for clean ones",
                )
            render_plan(chosen, run, trajectories, frames, workers)
        _write(kept, EpisodeLoader(folder, run.render), experiment.frame_px, workers, file)


def _link_files_of_other_arms(folder: Path) -> None:
    """Link the replays and frames of the other arms, as the arms have many clean episodes in common.

    A file is named after its content, so a file of the same name is the same.
    """
    for other, name in product(folder.parent.glob("*/"), (TRAJECTORIES, FRAMES)):
        for file in (other / name).rglob(f"*{SUFFIX}"):
            here = folder / file.relative_to(other)
            if not here.exists():
                here.parent.mkdir(parents=True, exist_ok=True)
                here.hardlink_to(file)


def planned(experiment: Experiment, arm: str, demos: Sequence[DemoEntry]) -> tuple[list[plan.Row], list[plan.Row]]:
    """Plan an arm with one wanted episode per demonstration; return all rows, and the rows that the arm may use.

    A reserve that replaces a failed episode may be of any demonstration of its task. All other rows are the clean twins
    of demonstrations with perturbed episodes. Arms of ``further`` also get the perturbed episodes of their runs.

    Raises:
        PipelineError: if a task has fewer demonstrations than wanted.
    """
    by_task: dict[str, list[DemoEntry]] = defaultdict(list)
    for demo in demos:
        by_task[f"{demo.task.suite}/{demo.task.name}"].append(demo)
    for task in experiment.tasks:
        if len(by_task[task]) < experiment.demonstrations:
            raise PipelineError(
                f"{len(by_task[task])} demonstrations of {task}, not {experiment.demonstrations}",
                where=experiment.run.demos.root,
                remedy="choose another task, or lower demonstrations in the experiment",
            )
    wanted, rows, begin = experiment.run.plan, [], 0
    for name in experiment.mixtures(arm):
        end = begin + wanted.episodes[name] // len(by_task)
        axes = wanted.axes.model_copy(update=dict.fromkeys(wanted.axes.configured().keys() - axes_of(name)))
        config = PlanConfig(seed=wanted.seed, axes=axes, episodes={name: wanted.episodes[name]}, reserve=wanted.reserve)
        group: list[DemoEntry] = []
        for task in experiment.tasks:
            group += by_task[task][begin:end]
        rows += plan.make(group, config, experiment.run.replay, benchmark.load())
        begin = end
    # Their ranks follow those of the perturbed episodes' twins, all of which are needed.
    clean: list[plan.Row] = []
    for task in experiment.tasks:
        for row in plan.twins(by_task[task][begin:], wanted.seed, experiment.run.replay):
            rank = begin + row.rank
            clean.append(replace(row, rank=rank, wanted=rank < experiment.demonstrations))
    chosen = [row for row in rows if row.role == "perturbed"] + clean
    # Replays of a perturbed episode follow the clean twin. Spare demonstrations have one only if they are needed.
    replayed = [by_task[task][: experiment.demonstrations] for task in experiment.tasks]
    further = _further(experiment, arm, list(chain.from_iterable(replayed)))
    return rows + clean + further, chosen + further


def _further(experiment: Experiment, arm: str, demos: Sequence[DemoEntry]) -> list[plan.Row]:
    """Plan the perturbed episodes of an arm's run; an empty list for an arm without one."""
    if arm not in experiment.further:
        return []
    run = experiment.further[arm].config
    return [row for row in plan.make(demos, run.plan, run.replay, benchmark.load()) if row.role == "perturbed"]


def perturbed_rows(file: Path) -> list[plan.Row]:
    """Return the rows of the plan of a dataset's perturbed episodes, without unused candidates."""
    with np.load(file) as arrays:
        kept = {row["episode_id"] for row in json.loads(str(arrays["episodes"]))}
    rows = plan.read(file.with_suffix("") / PLAN)
    return [row for row in rows if row.role == "perturbed" and row.episode_id in kept]


def _write(rows: Sequence[plan.Row], load: EpisodeLoader, frame_px: int, workers: Workers, file: Path) -> None:
    small = workers(partial(_small, load, frame_px), [row.episode_id for row in rows], "small frames")
    columns: dict[str, Any] = {}
    for name in small[0]:
        columns[name] = np.concatenate([episode[name] for episode in small])
    lengths = np.array([len(episode["action"]) for episode in small])
    facts: list[dict[str, Any]] = []
    for row in rows:
        facts.append({name: getattr(row, name) for name in COLUMNS})
    with replaced(file) as temporary, temporary.open("wb") as out:
        np.savez(out, **columns, lengths=lengths, episodes=np.array(json.dumps(facts)))


def _small(load: EpisodeLoader, frame_px: int, episode_id: str) -> dict[str, NDArray[Any]]:
    """Return an episode's small frames, states and actions."""
    episode = load(episode_id)
    images: dict[str, NDArray[Any]] = {}
    for view in VIEWS:
        frames = [resized(decode(frame), frame_px, frame_px) for frame in episode.frames[view]]
        images[view] = np.stack(frames)
    return {**images, "state": episode.state, "action": episode.action}


def read(file: Path) -> Dataset:
    """Read the output of ``make``; an arm of 200 episodes of 90 steps takes 1 GB of memory.

    Raises:
        PipelineError: if the file does not exist.
    """
    if not file.is_file():
        raise PipelineError("the arm has no data yet", where=file, remedy="generate the data by the step `data`")
    with np.load(file) as arrays:
        return Dataset(
            {view: arrays[view] for view in VIEWS},
            arrays["state"],
            arrays["action"],
            arrays["lengths"],
            json.loads(str(arrays["episodes"])),
        )
