"""Work of the stage ``render``: workers render the frames that a plan needs and the store lacks."""

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np

from pipeline import gl
from pipeline.compute.pool import Workers, run_job
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.planning.plan import Row
from pipeline.planning.streams import Stream, streams_of
from pipeline.run.progress import Progress, rejections
from pipeline.run.replay_stage import Replays
from pipeline.stores.frame_store import FrameStore, file_name, frames_by_trajectory
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict

STREAMS_OF_A_JOB = 64
"""Largest number of streams of a render job, which takes minutes of a core and some 200 MB of encoded frames.

A kill loses at most one job per worker. A trajectory's second job may have to open its scene again, which takes some
seconds.
"""

Portion = tuple[Row, tuple[Stream, ...]]
"""A row of the plan, and streams of its trajectory that are stored in one file."""


def portions(planned: Mapping[str, Stream], needed: Collection[str]) -> list[tuple[Stream, ...]]:
    """Cut the needed streams of a trajectory into portions of at most ``STREAMS_OF_A_JOB``, one file each.

    All planned streams are cut into portions first; unneeded streams are left out afterwards. A portion therefore does
    not change if a stream of another portion is rejected and a reserve replaces its episode. Streams that share a scene
    are next to each other.

    Args:
        planned: stream id to each stream that an episode of the plan shows, reserves included.
        needed: ids of the streams to render.
    """
    ordered = sorted(planned.items(), key=lambda item: (item[1].scene(textures=False), item[1].scene(), item[0]))
    number = math.ceil(len(ordered) / STREAMS_OF_A_JOB)
    cuts = [int(cut) for cut in np.linspace(0, len(ordered), number + 1)]
    needed_portions = []
    for start, end in pairwise(cuts):
        portion = tuple(stream for name, stream in ordered[start:end] if name in needed)
        if portion:
            needed_portions.append(portion)
    return needed_portions


def render_and_replace(
    rows: Sequence[Row], config: Config, replays: Replays, frames: FrameStore
) -> tuple[dict[str, Verdict], set[str]]:
    """Render the frames of every kept episode, and replay the reserves that replace episodes with rejected frames.

    ``render_plan`` takes reserves that are already replayed. This loop replays further ones, and ends with a pass in
    which no further frames are rejected.

    Returns:
        Trajectory id to verdict, for every trajectory that was needed, and the files of ``frames`` that the plan needs.

    Raises:
        PipelineError: as ``Replays.complete`` and ``render_plan``.
    """
    verdicts: dict[str, Verdict] = {}
    files: set[str] = set()
    rejected: dict[str, str] | None = None
    while True:
        rejected_now = rejections(rows, frames_by_trajectory(frames.rows()), config.render.content.views)
        if rejected_now == rejected:
            return verdicts, files
        rejected = rejected_now
        verdicts = replays.complete(rows, rejected)
        files = render_plan(rows, config, replays.store, frames, replays.workers)
        frames.keep(files)


def render_plan(
    rows: Sequence[Row], config: Config, trajectories: TrajectoryStore, frames: FrameStore, workers: Workers
) -> set[str]:
    """Render the missing streams of every kept episode, and of failures if the configuration requests them.

    Reserves replace episodes with rejected frames. Rendering therefore repeats until it has generated all files that it
    can from the stored trajectories.

    Returns:
        The files of ``frames`` that the plan needs. They do not depend on earlier renderings.

    Raises:
        PipelineError: when rendering leaves the same work undone.
    """
    device = gl.choose().device
    replays = trajectories.rows()
    undone: set[str] = set()
    while True:
        stored = {name: row for name, row in frames.refresh().items() if row["device"] == device}
        needed = _needed(Progress.of(rows, replays, stored, config))
        missing = {name: portion for name, portion in needed.items() if name not in stored}
        if not missing:
            return set(needed)
        if missing.keys() == undone:
            raise PipelineError(
                f"{len(missing)} files of frames were rendered and are still missing, such as this one",
                where=frames.path(next(iter(missing))),
                expected=f"files that workers write to this folder, rendered on {device}",
                remedy="check that all workers see this folder and have the same versions and OpenGL device",
            )
        undone = set(missing)
        # A stage that has nothing to do loads no simulator.
        from pipeline.rendering.renderer import scene_of_process
        from pipeline.run.render_job import RenderJob

        jobs = [
            RenderJob(*portion, trajectories.root, frames.root, config.render, device) for portion in missing.values()
        ]
        # Jobs of many streams come first, so that none of them runs alone at the end. In jobs of few streams the scene
        # takes most of the time. They are ordered by task and demonstration, as a worker keeps shared parts of scenes.
        jobs.sort(key=lambda job: (-len(job.streams), job.row.suite, job.row.task, job.row.demo_id))
        try:
            workers(run_job, jobs, "render, frames")
        finally:
            scene_of_process().close()


def _needed(progress: Progress) -> dict[str, Portion]:
    """Map the name of each file that the plan needs to its portion, by the verdicts and rejections so far."""
    # Episodes of a trajectory share its replay and its files, so any of their rows names its demonstration and task.
    row_of = {row.trajectory_id: row for row in progress.rows}
    planned: dict[str, dict[str, Stream]] = {trajectory_id: {} for trajectory_id in row_of}
    for row in progress.rows:
        planned[row.trajectory_id] |= _streams(row, progress.views)
    needed: dict[str, set[str]] = {}
    for row in progress.to_render():
        needed.setdefault(row.trajectory_id, set()).update(_streams(row, progress.views))
    files: dict[str, Portion] = {}
    for trajectory_id, stream_ids in needed.items():
        for portion in portions(planned[trajectory_id], stream_ids):
            name = file_name(trajectory_id, [stream.stream_id for stream in portion])
            files[name] = (row_of[trajectory_id], portion)
    return files


def _streams(row: Row, views: tuple[str, ...]) -> dict[str, Stream]:
    """Map the ids of an episode's streams to the streams."""
    return {stream.stream_id: stream for stream in streams_of(row.perturbations, views).values()}
