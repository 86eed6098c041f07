"""What depth, segmentation and object poses cost: seconds and bytes of an episode in the store of frames.

    nice -n 10 python benchmarks/extras.py [--task SUITE/TASK] [--steps N]

Both views of a clean episode, with the renderer that the program chooses. The last line is the result as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace

from pipeline import gl
from pipeline.config import RenderConfig, ReplayConfig
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.planning.streams import streams_of
from pipeline.rendering.last_scene import LastScene
from pipeline.rendering.render import render
from pipeline.types import Rendered, RenderedExtra, Task, Trajectory

ASKED: tuple[tuple[RenderedExtra, ...], ...] = (
    (),
    ("depth",),
    ("segmentation",),
    ("object_poses",),
    ("depth", "object_poses", "segmentation"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="libero_goal/put_the_bowl_on_the_plate")
    parser.add_argument("--steps", type=int, help="only so many of the episode's steps")
    arguments = parser.parse_args()
    task = find_task(*arguments.task.split("/"))
    environment = Environment(task)
    trajectory = replay(environment, StarterSource().of(task), "clean", ReplayConfig())
    environment.close()
    trajectory = replace(trajectory, actions=trajectory.actions[: arguments.steps])
    measure(trajectory, task, ())  # the first time, OpenGL compiles its programs
    costs = {"+".join(extras) or "frames alone": measure(trajectory, task, extras) for extras in ASKED}
    result = {"task": arguments.task, "steps": len(trajectory.actions), "device": gl.choose().device, "costs": costs}
    print(json.dumps(result))


def measure(trajectory: Trajectory, task: Task, extras: Sequence[RenderedExtra]) -> dict[str, float]:
    """Of rendering both views with extras: seconds by the clock and of all cores, bytes of frames and of extras."""
    clock_s, cpu_s = time.perf_counter(), time.process_time()
    with closing(LastScene()) as opened:
        streams = list(streams_of("[]").values())
        rendered = render(trajectory, task, streams, RenderConfig(extras=tuple(extras)), opened)
    return {
        "seconds": round(time.perf_counter() - clock_s, 2),
        "cpu_seconds": round(time.process_time() - cpu_s, 2),
        "frame_bytes": sum(len(frame) for frames in rendered.streams.values() for frame in frames),
        "extra_bytes": extra_bytes(rendered),
    }


def extra_bytes(rendered: Rendered) -> int:
    files = [file for view in rendered.geometry.values() for files in view.maps.values() for file in files]
    return sum(map(len, files)) + (0 if rendered.object_poses is None else rendered.object_poses.nbytes)


if __name__ == "__main__":
    main()
