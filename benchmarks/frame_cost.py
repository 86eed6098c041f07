"""What a frame costs in each of LIBERO's five arenas, beside MuJoCo's drawing of everything.

    nice -n 10 python benchmarks/frame_cost.py [--frames 80]

Replays one demonstration of the starter set in each arena, and renders as many frames of it with each camera, one by
one in both ways, and a quarter as many with all lamps casting shadows. The last line is JSON: for each arena and camera
the CPU time of a frame in ms, plain and ours, the share that is left, and how many frames are the same pixels.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

os.environ |= {"LP_NUM_THREADS": "1"}

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np

from pipeline.compute.pool import loop
from pipeline.config import load
from pipeline.episode_schema import SCHEMA
from pipeline.planning import plan
from pipeline.rendering.culling import Culling
from pipeline.rendering.renderer import Renderer
from pipeline.run.replay import replay_plan
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.types import Frame, Trajectory

ARENAS = {
    "tabletop": "libero_goal/put_the_bowl_on_the_plate",
    "floor": "libero_object/pick_up_the_orange_juice_and_place_it_in_the_basket",
    "kitchen": "libero_10/KITCHEN_SCENE3_*",
    "living room": "libero_10/LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_*",
    "study": "libero_10/STUDY_SCENE1_*",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=80, help="of each camera")
    arguments = parser.parse_args()
    config = load(Path("configs/starter.yaml"))
    figures = {}
    for arena, task in ARENAS.items():
        demos = config.demos.model_copy(update={"tasks": (task,)})
        rows = plan.make(demos.index().entries, config.plan, config.replay, benchmark.load())
        twin = next(row for row in rows if row.role == "twin")
        with TemporaryDirectory() as folder:
            replay_plan([twin], demos, config.replay, Path(folder), loop)
            trajectory = TrajectoryStore(Path(folder)).load(twin.trajectory_id)
        figures[arena] = {
            view + shadows: compared(trajectory, spec.camera, frames, bool(shadows))
            for shadows, frames in (("", arguments.frames), (" with shadows", arguments.frames // 4))
            for view, spec in SCHEMA.views.items()
        }
        print(arena, figures[arena], flush=True)
    print(json.dumps({"frames": arguments.frames, "arenas": figures}))


def compared(trajectory: Trajectory, camera: str, frames: int, shadows: bool) -> dict[str, float]:
    renderer = Renderer(trajectory.model_xml)
    renderer.model.light_castshadow[:] |= shadows
    steps = min(frames, len(trajectory.actions))
    plain_s = ours_s = 0.0
    same = 0

    def timed() -> tuple[Frame, float]:
        start = time.process_time()
        return renderer.frame(camera), time.process_time() - start

    try:
        for step in range(steps):
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            ours, seconds = timed()
            ours_s += seconds
            with patch.object(Culling, "picture", lambda culling, *_: culling.everything()):
                plain, seconds = timed()
            plain_s += seconds
            same += np.array_equal(ours, plain)
    finally:
        renderer.close()
    return {
        "plain_ms": round(1000 * plain_s / steps, 1),
        "ours_ms": round(1000 * ours_s / steps, 1),
        "share": round(ours_s / plain_s, 2),
        "frames": steps,
        "same_frames": same,
    }


if __name__ == "__main__":
    main()
