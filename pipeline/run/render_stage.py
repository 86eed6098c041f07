"""What the stage ``render`` does: the frames that a plan needs and the store lacks are rendered by workers."""

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline import gl
from pipeline.compute.pool import Expendable, Workers
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.planning.plan import Row
from pipeline.planning.selection import select
from pipeline.planning.streams import Stream, streams_of
from pipeline.run.outcome import MISSED, rejections
from pipeline.run.verdicts import verdicts_of
from pipeline.stores.frame_store import FrameStore, file_name, shown_of
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict

STREAMS_OF_A_JOB = 64
"""Bounds a render job: minutes of a core, which a kill loses at most, and some 200 MB of encoded frames.

A trajectory's second job may have to open its scene once more, which takes some seconds.
"""

Portion = tuple[Row, tuple[Stream, ...]]
"""A row of the plan, and streams of its trajectory that lie in one file."""


def portions(planned: Mapping[str, Stream], needed: Collection[str]) -> list[tuple[Stream, ...]]:
    """The needed streams of a trajectory, in portions of ``STREAMS_OF_A_JOB`` at most, each to be one file.

    All planned ones are cut, and then those left out that are not needed. So a portion does not change when a stream
    of another one is rejected and a reserve takes its place. Streams that share a scene are beside each other.

    Args:
        planned: stream id to each stream that an episode of the plan shows, reserves included.
        needed: ids of those that are to be rendered.
    """
    ordered = sorted(planned.items(), key=lambda item: (item[1].scene(textures=False), item[1].scene(), item[0]))
    cut = [int(end) for end in np.linspace(0, len(ordered), math.ceil(len(ordered) / STREAMS_OF_A_JOB) + 1)]
    wanted = [tuple(stream for name, stream in ordered[a:b] if name in needed) for a, b in pairwise(cut)]
    return [portion for portion in wanted if portion]


def render_plan(rows: Sequence[Row], config: Config, trajectories: Path, folder: Path, workers: Workers) -> set[str]:
    """Render the streams of every kept episode, and of failures where asked for, that ``folder`` does not hold yet.

    Where frames are rejected, reserves take the place of their episodes, so this goes on until nothing is missing that
    can be made from the trajectories that are there.

    Returns:
        The files of ``folder`` that the plan needs: the same ones whatever was rendered before.

    Raises:
        PipelineError: when rendering leaves the same work undone.
    """
    device = gl.choose().device
    store = FrameStore(folder, config.render)
    judged = verdicts_of(TrajectoryStore(trajectories).rows(), rows, config.filter)
    undone: set[str] = set()
    while True:
        stored = {name: row for name, row in store.refresh().items() if row["device"] == device}
        needed = _needed(rows, judged, rejections(rows, shown_of(stored)), MISSED if config.export.failures else ())
        missing = {name: portion for name, portion in needed.items() if name not in stored}
        if not missing:
            return set(needed)
        if missing.keys() == undone:
            raise PipelineError(
                f"{len(missing)} files of frames were rendered and are still not there, such as this one",
                where=store.path(next(iter(missing))),
                expected=f"files written there by workers, rendered on {device}",
                remedy="check that all workers see this folder and have the same versions and OpenGL device",
            )
        undone = set(missing)
        # A stage that has nothing to do loads no simulator.
        from pipeline.rendering.renderer import scene_of_process
        from pipeline.run.render_job import RenderJob

        # Those of many streams first, so that no worker is left alone with one at the end. Those of few, to which the
        # scene matters, by task and demonstration: what their scenes have in common, a worker keeps.
        in_turn = sorted(missing.values(), key=lambda one: (-len(one[1]), one[0].suite, one[0].task, one[0].demo_id))
        jobs = [RenderJob(*portion, trajectories, folder, config.render, device) for portion in in_turn]
        work = Expendable(RenderJob.__call__, RenderJob.limit_s, RenderJob.lost, RenderJob.frames_at_most)
        try:
            workers(work, jobs, "render, frames")
        finally:
            scene_of_process().close()


def _needed(
    rows: Sequence[Row], judged: Mapping[str, Verdict], rejected: Mapping[str, str], failures: Collection[str]
) -> dict[str, Portion]:
    """Name of each file that the plan needs to what is in it, as far as verdicts and rejections are known.

    Args:
        judged: trajectory id to its verdict.
        rejected: episode id to the reason why its frames were rejected.
        failures: reasons of dropped episodes that are rendered too.
    """
    row_of = {row.trajectory_id: row for row in rows}
    planned: dict[str, dict[str, Stream]] = {trajectory_id: {} for trajectory_id in row_of}
    needed: dict[str, set[str]] = {}
    outcome = select(rows, judged, rejected)
    for row in rows:
        shown = {stream.stream_id: stream for stream in streams_of(row.perturbations).values()}
        planned[row.trajectory_id] |= shown
        verdict = outcome[row.episode_id]
        # A rejected stream stays needed: without it, its episode would be tried again.
        if verdict.kept or verdict.reason in (rejected.get(row.episode_id), *failures):
            needed.setdefault(row.trajectory_id, set()).update(shown)
    return {
        file_name(trajectory_id, [stream.stream_id for stream in portion]): (row_of[trajectory_id], portion)
        for trajectory_id, ids in needed.items()
        for portion in portions(planned[trajectory_id], ids)
    }
