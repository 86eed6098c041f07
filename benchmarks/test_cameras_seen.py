"""Visibility of the hand and of the task's objects in LIBERO-Plus's 1,599 test cameras.

    nice -n 10 python benchmarks/test_cameras_seen.py data/test_cameras_seen.jsonl

Each test camera views the starter demonstration of its task, replayed open-loop. The hand is measured at all steps, the
objects in the first frame. The file stores a line for each test camera; a stopped run resumes from it. The output is
JSON with these numbers for each arena and component:

- the number of cameras;
- the largest share of the steps at which the hand is outside of the frame;
- the number of cameras that show an object on fewer than ``LEAST_PX`` pixels, where LIBERO's own camera shows more.

``nominal`` is LIBERO's own camera. ``TESTED_OUTSIDE`` of ``pipeline/rendering/sight.py`` has the largest share of each
component. The script takes about 4 minutes.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import ReplayConfig
from pipeline.evaluation.libero_plus import camera
from pipeline.libero import bddl
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import environment_of
from pipeline.physics.replay import replay
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.sight import LEAST_PX, Sight
from pipeline.scenes.compiled import proprioception
from pipeline.testset import benchmark
from pipeline.types import Floats, Task, Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("kept", type=Path, help="file of the results")
    arguments = parser.parse_args()
    arguments.kept.parent.mkdir(parents=True, exist_ok=True)
    arguments.kept.touch()
    measured = {line["task"] for line in map(json.loads, arguments.kept.read_text().splitlines())}
    all_tasks = [task for suite in benchmark.TESTED_SUITES for task in tasks(suite)]
    for task in all_tasks:
        if str(task) not in measured:
            lines = measure(task)
            with arguments.kept.open("a") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
            print(task, len(lines), file=sys.stderr, flush=True)
    print(json.dumps(summary([json.loads(line) for line in arguments.kept.read_text().splitlines()]), indent=1))


def measure(task: Task) -> list[dict[str, Any]]:
    """Return a line for LIBERO's own camera and for each test camera of a task."""
    demo = StarterSource().demonstration(task)
    trajectory = replay(environment_of(task), demo, "test_cameras", ReplayConfig(mode="open_loop"))
    arena = bddl.read(task.bddl_file).arena
    renderer = Renderer(trajectory.model_xml)
    hand_m = hand_way(renderer, trajectory)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    lines = [{"task": str(task), "arena": arena, "component": "nominal", **sight(renderer, task, hand_m)}]
    for test in benchmark.load().on(task, "camera"):
        with renderer.perturbed([camera(test)]):
            renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
            line = {"task": str(task), "arena": arena, "component": test.component, **sight(renderer, task, hand_m)}
            lines.append(line | {"test": test.name})
    renderer.close()
    return lines


def hand_way(renderer: Renderer, trajectory: Trajectory) -> Floats:
    """Return the hand's position (K, 3) before each action, in m in the world, as ``rendering/render.py`` does."""
    places = []
    for state, alpha in zip(trajectory.states[:-1], trajectory.site_alpha[:-1], strict=True):
        renderer.restore(state, alpha)
        places.append(proprioception(renderer.data)[0][:3])
    return np.stack(places).astype(float)


def sight(renderer: Renderer, task: Task, hand_m: Floats) -> dict[str, Any]:
    seen = Sight.of(renderer, task, hand_m)
    return {"hand_outside": round(seen.hand_outside, 4), "things_px": seen.things_px}


def summary(lines: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Summarize the lines by arena and component."""
    nominal = {line["task"]: line["things_px"] for line in lines if line["component"] == "nominal"}
    kinds: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for line in lines:
        kinds[line["arena"], line["component"]].append(line)
    figures: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    for (arena, component), cameras in sorted(kinds.items()):
        outside = max(camera["hand_outside"] for camera in cameras)
        hiding = sum(hides(camera["things_px"], nominal[camera["task"]]) for camera in cameras)
        figures[arena][component] = {"cameras": len(cameras), "hand_outside": outside, "hiding_a_thing": hiding}
    return figures


def hides(things_px: dict[str, int], nominal_px: dict[str, int]) -> bool:
    """Check if an object of the task shows on too few pixels, while LIBERO's own camera shows it on more."""
    return any(px < min(LEAST_PX, nominal_px[thing]) for thing, px in things_px.items())


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
