"""Every kept trajectory of a run once more in LIBERO's own environment: the same states, bit for bit, and the goal.

    nice -n 10 python benchmarks/repeat_in_libero.py data/starter [--limit 10]

Each is put where its replay started, settles, and is sent the stored actions by LIBERO's own ``step``; nothing of
``pipeline/physics/`` takes part, and nothing is rendered. A name is printed for each trajectory that differs. The last
line is JSON: how many there are by what is perturbed, and how many were repeated. 30 took 1.5 minutes of CPU.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np

from pipeline.libero.tasks import find_task
from pipeline.planning import plan
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Scene, Task, Trajectory

STEP_S = 0.05
"""What a control step takes, by which the states tell how many steps the scene settled."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="a finished run's folder")
    parser.add_argument("--limit", type=int, help="trajectories; all when left out")
    arguments = parser.parse_args()
    store = TrajectoryStore(arguments.data / "trajectories")
    replayed = store.rows()
    rows = {row.trajectory_id: row for row in plan.read(arguments.data / "plan.parquet")}
    kept = sorted(
        (row for name, row in rows.items() if name in replayed and replayed[name]["kept"]),
        key=lambda row: (row.suite, row.task),
    )
    tried: Counter[str] = Counter()
    equal: Counter[str] = Counter()
    env, task = None, None
    for row in kept[: arguments.limit]:
        if task != (task := find_task(row.suite, row.task)):
            env = opened(task)
        trajectory = store.load(row.trajectory_id)
        # Episodes that change no physics share the clean twin's trajectory.
        what = row.component if trajectory.resolved != "{}" else "clean"
        tried[what] += 1
        if (difference := repeated(env, trajectory)) is None:
            equal[what] += 1
        else:
            print(f"{row.trajectory_id} ({what}, {row.suite}/{row.task}): {difference}")
        print(f"{sum(tried.values())} of {len(kept[: arguments.limit])}", file=sys.stderr)
    print(json.dumps({"trajectories": dict(tried), "tried": tried.total(), "repeated": equal.total()}))
    sys.exit(tried != equal)


def opened(task: Task) -> Any:
    """LIBERO's environment of a task, without a renderer."""
    from libero.libero.envs.env_wrapper import ControlEnv
    from robosuite.utils.errors import RandomizationError

    while True:
        with suppress(RandomizationError):
            return ControlEnv(
                bddl_file_name=str(task.bddl_file),
                has_offscreen_renderer=False,
                use_camera_obs=False,
                ignore_done=True,
            )


def repeated(env: Any, trajectory: Trajectory) -> str | None:
    """Do what a trajectory did; what was otherwise, or None.

    Args:
        env: LIBERO's ``ControlEnv`` of its task.
        trajectory: what to repeat.
    """
    put_in(env, trajectory.scene)
    settled = round((trajectory.states[0, 0] - trajectory.scene.state[0]) / STEP_S)
    for _ in range(settled):
        env.step([0.0] * 6 + [-1.0])
    if not np.array_equal(env.get_sim_state(), trajectory.states[0]):
        return f"another first look after {settled} steps"
    for number, (action, state) in enumerate(zip(trajectory.actions, trajectory.states[1:], strict=True), 1):
        if (push := trajectory.scene.push) is not None:
            acts = push.first_step < number <= push.first_step + push.steps
            env.sim.data.xfrc_applied[env.sim.model.body_name2id(push.body)] = push.wrench if acts else 0.0
        env.step(action)
        if not np.array_equal(env.get_sim_state(), state):
            return f"another state after {number} of {len(trajectory.actions)} actions"
    return None if env.check_success() else "the goal is not reached"


def put_in(env: Any, scene: Scene) -> None:
    """Start LIBERO's environment where a replay starts, which is more than a state: ``Scene`` says what.

    The solver starts from its last result, so that these are the steps of ``Environment.restore``, in its order.
    """
    env.reset_from_xml_string(scene.model_xml)
    sim, robot = env.sim, env.robots[0]
    arm, speeds = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
    # Of both fingers.
    robot.gripper.current_action = scene.gripper * np.array([-1.0, 1.0])
    sim.reset()
    env.set_state(scene.state)
    if scene.posture_rad is not None:
        sim.data.qpos[arm], sim.data.qvel[speeds] = scene.posture_rad, 0.0
    sim.forward()
    robot.controller.update_initial_joints(sim.data.qpos[arm])
    if scene.posture_rad is not None:
        env.set_init_state(scene.state)


if __name__ == "__main__":
    main()
