"""Comparison of the render stage with one worker, with several workers, and of the bare rendering of its frames.

    python benchmarks/render_workers.py [--config configs/starter.yaml] [--tasks 'libero_goal/put_the_bowl_*' ...]

The script takes one demonstration of the starter set for each task, and the configuration's number of episodes for each
demonstration. They are replayed once. Then the frames are rendered three times: in this process, with one worker
process, and with several. In this process, the time within ``Renderer.start_frame`` is counted, which renders a frame
at once in software. Each process renders with one thread.

Run the script on an otherwise idle machine, with tasks of similar scenes. The streams of a demonstration are one job;
if two jobs differ, one worker waits for the other.

The last line is JSON. Wall seconds exclude the start of the workers. Bare rendering has CPU seconds too, as one process
renders on little more than one core. The other figures are the time of all workers relative to bare rendering, and the
speed-up of several workers over one.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from episode_slice import sliced

from pipeline.compute.pool import Workers, loop, runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import load
from pipeline.machine_code import MACHINE_CODE_VARIABLES, ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.rendering.renderer import Renderer
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.types import Frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--config", type=Path, default=Path("configs/starter.yaml"))
    parser.add_argument("--tasks", nargs="+", help="tasks; by default those of the configuration")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    config = sliced(load(arguments.config), arguments.tasks)
    rows = plan.make(config.demos.index().entries, config.plan, config.replay, benchmark.load())
    with TemporaryDirectory() as temporary:
        root = Path(temporary)
        trajectories = root / "trajectories"
        Replays(config.demos, config.replay, TrajectoryStore(trajectories), loop, config.filter).complete(rows)

        def rendered(run: Workers, name: str) -> float:
            start = time.perf_counter()
            render_plan(rows, config, TrajectoryStore(trajectories), FrameStore(root / name, config.render), run)
            return time.perf_counter() - start

        frames_s: list[tuple[float, float]] = []
        start_frame = Renderer.start_frame

        def timed(renderer: Renderer, camera: str) -> Callable[[], Frame]:
            start_s, start_cpu_s = time.perf_counter(), time.process_time()
            wait = start_frame(renderer, camera)
            frames_s.append((time.perf_counter() - start_s, time.process_time() - start_cpu_s))
            return wait

        with patch.object(Renderer, "start_frame", timed):
            here_s = rendered(loop, "here")
        by_workers = {}
        for workers in (1, arguments.workers):
            config_of_workers = ComputeConfig(cluster="local", workers=workers)
            # With spare cores, a worker would render with several threads.
            with patch("dask.system.CPU_COUNT", workers), runner(config_of_workers, root, renders=True) as run:
                run(_warm, range(4 * workers), "workers")
                by_workers[workers] = rendered(run, f"by_{workers}")
    bare_s, bare_cpu_s = map(sum, zip(*frames_s, strict=True))
    several_s = by_workers[arguments.workers]
    print(
        json.dumps(
            {
                "config": str(arguments.config),
                "frames_drawn": len(frames_s),
                "bare_s": round(bare_s, 1),
                "bare_cpu_s": round(bare_cpu_s, 1),
                "one_process_s": round(here_s, 1),
                "s_by_workers": {workers: round(seconds, 1) for workers, seconds in by_workers.items()},
                "workers_against_bare": round(arguments.workers * several_s / bare_s, 2),
                "workers_against_bare_cpu": round(arguments.workers * several_s / bare_cpu_s, 2),
                "several_against_one": round(by_workers[1] / several_s, 2),
            }
        )
    )


def _warm(number: int) -> None:
    """Import the modules of rendering in a worker."""
    import pipeline.rendering.render  # noqa: F401

    time.sleep(0.2)


if __name__ == "__main__":
    ensure_fixed_machine_code(MACHINE_CODE_VARIABLES | {"LP_NUM_THREADS": "1"})
    main()
