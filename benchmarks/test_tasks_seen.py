"""What a policy sees in LIBERO's and LIBERO-Plus's evaluations, for `python -m pipeline analyse coverage`.

    nice -n 10 python benchmarks/test_tasks_seen.py > pipeline/testset/seen.json

First looks are those of all 40 tasks, from their first initial state. Robot starts are those of one test task of each
of the 40 at each level. A working surface and the walls are counted in the first look of one task of each arena, and
noise at the severities 1, 5 and 10 is laid on these looks. It takes about ten minutes without a GPU.
"""

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing

from pipeline import gl  # before NumPy, whose machine code it fixes

# isort: split
import numpy as np

gl.prepare()

from pipeline.axes import level_of_test  # noqa: E402
from pipeline.episode_schema import SCHEMA  # noqa: E402
from pipeline.evaluation import libero_plus  # noqa: E402
from pipeline.evaluation.simulator import Simulator  # noqa: E402
from pipeline.evaluation.tasks import libero_states  # noqa: E402
from pipeline.libero import bddl  # noqa: E402
from pipeline.libero.tasks import tasks  # noqa: E402
from pipeline.rendering.renderer import Renderer  # noqa: E402
from pipeline.report.seen import Look, spread  # noqa: E402
from pipeline.testset import benchmark  # noqa: E402
from pipeline.testset.benchmark import TestTask  # noqa: E402
from pipeline.types import Task  # noqa: E402

SEVERITIES = (1, 5, 10)
WALLS = ("walls_mat", "kitchen_background")
"""Materials of what stands around the working surface."""


def main() -> None:
    values: dict[str, list[float]] = defaultdict(list)
    looks: dict[tuple[str, str], Look] = {}
    shown: set[str] = set()
    for task in (task for suite in benchmark.TESTED_SUITES for task in tasks(suite)):
        with closing(Simulator(task)) as simulator:
            simulator.start(0, libero_states(task)[0])
            look = looks[task.suite, task.name] = Look.of(simulator.model, simulator.state)
            measured = list(look.measures().items())
            if (arena := bddl.read(task.bddl_file).arena) not in shown:
                shown.add(arena)
                measured += _frames(simulator, arena)
            for number, test in _robot_starts(task):
                simulator.start(0, libero_states(task)[0], libero_plus.postures_rad()[number])
                moved = Look.of(simulator.model, simulator.state)
                level = level_of_test(test)
                measured += moved.away_from(look, "controller_posture", level).items()
        for name, value in measured:
            values[name].append(value)
        print(task.name, file=sys.stderr)
    print(json.dumps({name: spread(measured) for name, measured in sorted(values.items())}, indent=1))


def _robot_starts(task: Task) -> list[tuple[int, TestTask]]:
    """The first robot test task of each level that perturbs a task, by the number of its posture."""
    chosen: dict[int, TestTask] = {}
    for test in benchmark.load().on(task, "robot"):
        chosen.setdefault(level_of_test(test), test)
    return [(int(test.parameters["id"]), test) for test in chosen.values()]


def _frames(simulator: Simulator, arena: str) -> Iterator[tuple[str, float]]:
    """What a test task of background changes in each view, and how much noise there is in the agent view."""
    renderer = Renderer(simulator.model)
    model, surface = simulator.model, "floor" if arena == "floor" else "table"
    renderer.restore(simulator.state, simulator.site_alpha)
    for view, spec in SCHEMA.views.items():
        geoms = renderer.geoms(spec.camera)
        bodies = [model.body(model.body_rootid[model.geom_bodyid[geom]]).name for geom in range(model.ngeom)]
        materials = [model.mat(mat).name if (mat := model.geom_matid[geom]) >= 0 else "" for geom in range(model.ngeom)]
        on_surface = np.isin(geoms, [geom for geom, body in enumerate(bodies) if body.endswith(surface)])
        around = np.isin(geoms, [geom for geom, material in enumerate(materials) if material in WALLS])
        yield f"background: share of {view} that surface changes", float(on_surface.mean())
        yield f"background: share of {view} that theme changes", float((on_surface | around).mean())
    clean = renderer.frame("agentview")
    for test in {(t.component, t.parameters["severity"]): t for t in benchmark.load().of("noise")}.values():
        if test.parameters["severity"] in SEVERITIES:
            noisy = libero_plus.noise(test, 0).apply(clean, 0)
            yield f"noise: {test.component} (mean grey levels)", float(np.abs(noisy.astype(float) - clean).mean())
    renderer.close()


if __name__ == "__main__":
    main()
