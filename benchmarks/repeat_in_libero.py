"""Repetition of a run's kept trajectories in LIBERO's own environment: equal states, bit for bit, and the goal.

    nice -n 10 python benchmarks/repeat_in_libero.py data/starter [--limit 10]
    nice -n 10 python benchmarks/repeat_in_libero.py data/demos
    nice -n 10 python benchmarks/repeat_in_libero.py data/starter/hdf5

The folder belongs to a finished run, or ``demos expand`` or the format ``hdf5`` wrote it; then its HDF5 files are read.
The first of several episodes with equal actions, states and scene is repeated. The environment starts where the replay
started, settles, and gets the stored actions through LIBERO's own ``step``. No code of ``pipeline/physics/`` is used,
and nothing is rendered. The name of each trajectory that differs is printed. The last
line is JSON: the number of trajectories by perturbed component, and the number of equal ones. 30 trajectories took 1.5
minutes of CPU.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.axes import task_of
from pipeline.formats.hdf5.layout import START_STATE
from pipeline.formats.hdf5.read import scene_of
from pipeline.libero import hdf5
from pipeline.libero.carried import bddl_text
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Demo, Floats, Scene, Task

STEP_S = 0.05
"""Duration of a control step; the times of the states give the number of settling steps."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of a finished run or of demonstrations")
    parser.add_argument("--limit", type=int, help="number of trajectories; all by default")
    arguments = parser.parse_args()
    is_run = (arguments.data / "plan.parquet").exists()
    trajectories = of_run(arguments.data) if is_run else _of_demonstrations(arguments.data)
    tried: Counter[str] = Counter()
    equal: Counter[str] = Counter()
    env, task = None, None
    for done in islice(trajectories, arguments.limit):
        if task != done.task:
            env = opened(done.task)
        task = done.task
        tried[done.what] += 1
        difference = repeated(env, done)
        if difference is None:
            equal[done.what] += 1
        else:
            print(f"{done.name} ({done.what}, {task.suite}/{task.name}): {difference}")
        print(f"{tried.total()} done", file=sys.stderr)
    print(json.dumps({"trajectories": dict(tried), "tried": tried.total(), "repeated": equal.total()}))
    sys.exit(tried != equal)


class Done(NamedTuple):
    """A finished trajectory: actions (K, 7) from a scene; states (K+1, S), or (K, S) without the final state."""

    task: Task
    what: str
    name: str
    scene: Scene
    states: Floats
    actions: Floats


def of_run(folder: Path) -> Iterator[Done]:
    store = TrajectoryStore(folder / "trajectories")
    replayed = store.rows()
    rows = {row.trajectory_id: row for row in plan.read(folder / "plan.parquet")}
    kept = [row for name, row in rows.items() if name in replayed and replayed[name]["kept"]]
    for row in sorted(kept, key=lambda row: (row.suite, row.task)):
        trajectory = store.load(row.trajectory_id)
        # Episodes that change no physics share the clean twin's trajectory.
        what = row.component if trajectory.resolved != "{}" else "clean"
        task = task_of(row.suite, row.task, row.perturbations)
        yield Done(task, what, row.trajectory_id, trajectory.scene, trajectory.states, trajectory.actions)


def _of_demonstrations(root: Path) -> Iterator[Done]:
    source, files = HDF5Source(root), sorted(root.glob("*/*_demo.hdf5"))
    for file in files:
        task = find_task(file.parent.name, file.name.removesuffix("_demo.hdf5"))
        for entry in source.index([task]).entries:
            demo = source.load(entry.demo_id)
            scene = _exported_start(file, demo) or recorded_start(demo, str(demo.model_xml), settles=False)
            yield Done(task, entry.origin, entry.demo_id, scene, np.array(demo.states), demo.actions)


def _exported_start(file: Path, demo: Demo) -> Scene | None:
    """Return the start of an episode of the format ``hdf5``; ``None`` for a demonstration."""
    with hdf5.opened(file) as content:
        group = content["data"][demo.key]
        if START_STATE not in group.attrs:
            return None
        return replace(scene_of(dict(group.attrs)), model_xml=str(demo.model_xml))


def opened(task: Task) -> Any:
    """Open LIBERO's environment of a task, without a renderer."""
    from libero.libero.envs.env_wrapper import ControlEnv
    from robosuite.utils.errors import RandomizationError

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / task.bddl_file.name
        file.write_text(bddl_text(task))
        while True:
            with suppress(RandomizationError):
                return ControlEnv(
                    bddl_file_name=str(file),
                    has_offscreen_renderer=False,
                    use_camera_obs=False,
                    ignore_done=True,
                )


def repeated(env: Any, done: Done) -> str | None:
    """Repeat a trajectory in LIBERO's ``ControlEnv`` of its task; return the first difference, or ``None``."""
    put_in(env, done.scene)
    settled = round((done.states[0, 0] - done.scene.state[0]) / STEP_S)
    for _ in range(settled):
        env.step([0.0] * 6 + [-1.0])
    if not np.array_equal(env.get_sim_state(), done.states[0]):
        return f"another first observation after {settled} steps"
    for number, action in enumerate(done.actions, 1):
        push = done.scene.start.push
        if push is not None:
            acts = push.first_step < number <= push.first_step + push.steps
            env.sim.data.xfrc_applied[env.sim.model.body_name2id(push.body)] = push.wrench if acts else 0.0
        env.step(action)
        if number < len(done.states) and not np.array_equal(env.get_sim_state(), done.states[number]):
            return f"another state after {number} of {len(done.actions)} actions"
    return None if env.check_success() else "the goal is not reached"


def put_in(env: Any, scene: Scene) -> None:
    """Start LIBERO's environment where a replay starts; a start is more than a state, see ``Scene``.

    The solver starts from its last result. The steps and their order are therefore those of ``Environment.restore``.
    """
    env.reset_from_xml_string(scene.model_xml)
    sim, robot = env.sim, env.robots[0]
    arm, speeds = robot.controller.qpos_index, robot.controller.qvel_index
    # The last gripper command of both fingers.
    robot.gripper.current_action = scene.start.gripper * np.array([-1.0, 1.0])
    sim.reset()
    env.set_state(scene.state)
    if scene.start.posture_rad is not None:
        sim.data.qpos[arm], sim.data.qvel[speeds] = scene.start.posture_rad, 0.0
    sim.forward()
    robot.controller.update_initial_joints(sim.data.qpos[arm])
    if scene.start.posture_rad is not None:
        env.set_init_state(scene.state)


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
