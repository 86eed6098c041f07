"""Cost of a frame in each of LIBERO's five arenas, rendered by plain MuJoCo and with savings.

    nice -n 10 python benchmarks/frame_cost.py [--frames 80] [--view front_image ...] [--size-px 512]

The script replays one demonstration of the starter set in each arena. It renders ``--frames`` of its frames with each
camera in both ways, and a quarter of them with all lamps casting shadows. For each frame, the state is restored and the
picture encoded, as in the render stage. The last line is JSON with these figures for each arena and camera:

- the CPU time of a frame in ms, both ways;
- the part of it outside of ``mjr_render`` and ``mjr_readPixels``;
- our time as a share of the plain time;
- the number of frames with equal pixels.
"""

import argparse
import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from replayed_twin import replayed_twin

from pipeline.config import RenderConfig, load
from pipeline.episode_schema import ALL_VIEWS, SCHEMA, SIZE_PX
from pipeline.images.jpeg import encode, to_policy
from pipeline.machine_code import MACHINE_CODE_VARIABLES, ensure_fixed_machine_code
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import Renderer
from pipeline.types import Frame, Trajectory

ARENAS = {
    "tabletop": "libero_goal/put_the_bowl_on_the_plate",
    "floor": "libero_object/pick_up_the_orange_juice_and_place_it_in_the_basket",
    "kitchen": "libero_10/KITCHEN_SCENE3_*",
    "living room": "libero_10/LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_*",
    "study": "libero_10/STUDY_SCENE1_*",
}


class Clock:
    """CPU seconds within calls of some functions of MuJoCo."""

    def __init__(self, *names: str):
        self.spent_s = 0.0
        for name in names:
            setattr(mujoco, name, self._timed(getattr(mujoco, name)))

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments)
            finally:
                self.spent_s += time.process_time() - start

        return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=80, help="number of frames of each camera")
    parser.add_argument("--view", choices=ALL_VIEWS, action="append", help="a view to render; by default the usual two")
    parser.add_argument("--size-px", type=int, default=SIZE_PX, help="height and width of the frames")
    arguments = parser.parse_args()
    config, rendering = load(Path("configs/starter.yaml")), Clock("mjr_render", "mjr_readPixels")
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for arena, task in ARENAS.items():
        with TemporaryDirectory() as folder:
            trajectory = replayed_twin(config, task, Path(folder))
        figures[arena] = {}
        for shadows, frames in (("", arguments.frames), (" with shadows", arguments.frames // 4)):
            for view in arguments.view or SCHEMA.views:
                renderers = opened_both_ways(trajectory, arguments.size_px)
                figures[arena][view + shadows] = compared(
                    trajectory, renderers, ALL_VIEWS[view].camera, frames, bool(shadows), rendering
                )
        print(arena, figures[arena], flush=True)
    print(json.dumps({"frames": arguments.frames, "size_px": arguments.size_px, "arenas": figures}))


def opened_both_ways(trajectory: Trajectory, size_px: int) -> dict[str, Renderer]:
    ours = Renderer(trajectory.model_xml, size_px=size_px)
    return {"plain": Renderer(ours.model, PlainRenderer(ours.model, size_px)), "ours": ours}


def compared(
    trajectory: Trajectory, renderers: dict[str, Renderer], camera: str, frames: int, shadows: bool, rendering: Clock
) -> dict[str, float]:
    renderers["ours"].model.light_castshadow[:] |= shadows
    steps = range(min(frames, len(trajectory.actions)))
    with closing(renderers["ours"]), closing(renderers["plain"]):
        spent_s, other_s = dict.fromkeys(renderers, 0.0), dict.fromkeys(renderers, 0.0)
        same = 0
        for step in steps:
            pictures: list[Frame] = []
            for name, renderer in renderers.items():
                start, rendering_before_s = time.process_time(), rendering.spent_s
                renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
                pictures.append(renderer.frame(camera))
                encode(to_policy(pictures[-1]), RenderConfig().jpeg_quality)
                took_s = time.process_time() - start
                spent_s[name] += took_s
                other_s[name] += took_s - (rendering.spent_s - rendering_before_s)
            same += np.array_equal(pictures[0], pictures[1])
    return {
        **{f"{name}_ms": round(1000 * seconds / len(steps), 1) for name, seconds in spent_s.items()},
        **{f"{name}_beside_drawing_ms": round(1000 * seconds / len(steps), 2) for name, seconds in other_s.items()},
        "share": round(spent_s["ours"] / spent_s["plain"], 2),
        "frames": len(steps),
        "same_frames": same,
    }


if __name__ == "__main__":
    ensure_fixed_machine_code(MACHINE_CODE_VARIABLES | {"LP_NUM_THREADS": "1"})
    main()
