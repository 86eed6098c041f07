"""Measures of the observations in LIBERO's and LIBERO-Plus's evaluations, for the command `analyze observations`.

    nice -n 10 python benchmarks/test_tasks_seen.py > pipeline/testset/seen.json

First observations come from the first initial state of all 40 tasks. Robot starts come from one test task per task and
level. The pixels of working surface and walls are counted in the first observation of one task of each arena. Noise of
the severities 1, 5 and 10 is applied to these observations. The script takes about ten minutes without a GPU.
"""

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing

import numpy as np

from pipeline.axes import level_of_test
from pipeline.axes.robot import measure_start
from pipeline.episode_schema import SCHEMA
from pipeline.evaluation import libero_plus
from pipeline.evaluation.simulator import Simulator
from pipeline.evaluation.tasks import libero_states
from pipeline.libero import bddl
from pipeline.libero.tasks import tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.rendering.renderer import Renderer
from pipeline.report.seen import clean_measures, spread
from pipeline.scenes.look import Look
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask
from pipeline.types import Task

SEVERITIES = (1, 5, 10)
WALLS = ("walls_mat", "kitchen_background")
"""Materials of the walls around the working surface."""


def main() -> None:
    values: dict[str, list[float]] = defaultdict(list)
    looks: dict[tuple[str, str], Look] = {}
    measured_arenas: set[str] = set()
    all_tasks = [task for suite in benchmark.TESTED_SUITES for task in tasks(suite)]
    for task in all_tasks:
        with closing(Simulator(task)) as simulator:
            simulator.start(0, libero_states(task)[0])
            look = looks[task.suite, task.name] = Look.of(simulator.model, simulator.state)
            measured = list(clean_measures(look).items())
            arena = bddl.read(task.bddl_file).arena
            if arena not in measured_arenas:
                measured_arenas.add(arena)
                measured += _frames(simulator, arena)
            for number, test in _robot_starts(task):
                simulator.start(0, libero_states(task)[0], libero_plus.postures_rad()[number])
                moved = Look.of(simulator.model, simulator.state)
                for what, value in measure_start(moved, look, "controller_posture", level_of_test(test)):
                    measured.append((f"robot: {what}", value))
        for name, value in measured:
            values[name].append(value)
        print(task.name, file=sys.stderr)
    print(json.dumps({name: spread(measured) for name, measured in sorted(values.items())}, indent=1))


def _robot_starts(task: Task) -> list[tuple[int, TestTask]]:
    """Return (posture number, test) of the first robot test task of each level that perturbs a task."""
    chosen: dict[int, TestTask] = {}
    for test in benchmark.load().on(task, "robot"):
        chosen.setdefault(level_of_test(test), test)
    return [(int(test.parameters["id"]), test) for test in chosen.values()]


def _frames(simulator: Simulator, arena: str) -> Iterator[tuple[str, float]]:
    """Measure the share of each view that background test tasks change, and the noise of the agent view."""
    renderer = Renderer(simulator.model)
    model, surface = simulator.model, "floor" if arena == "floor" else "table"
    renderer.restore(simulator.state, simulator.site_alpha)
    for view, spec in SCHEMA.views.items():
        geoms = renderer.geoms(spec.camera)
        bodies = [model.body(model.body_rootid[model.geom_bodyid[geom]]).name for geom in range(model.ngeom)]
        materials = [model.mat(material).name if material >= 0 else "" for material in model.geom_matid]
        surface_geoms = [geom for geom, body in enumerate(bodies) if body.endswith(surface)]
        wall_geoms = [geom for geom, material in enumerate(materials) if material in WALLS]
        on_surface, around = np.isin(geoms, surface_geoms), np.isin(geoms, wall_geoms)
        yield f"background: share of {view} changed by surface", float(on_surface.mean())
        yield f"background: share of {view} changed by theme", float((on_surface | around).mean())
    clean = renderer.frame("agentview")
    tests = {(test.component, test.parameters["severity"]): test for test in benchmark.load().on_axis("noise")}
    for test in tests.values():
        if test.parameters["severity"] in SEVERITIES:
            noisy = libero_plus.noise(test, 0).apply(clean, 0)
            change = float(np.abs(noisy.astype(float) - clean).mean())
            yield f"noise: {test.component} (mean change in grey levels)", change
    renderer.close()


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
