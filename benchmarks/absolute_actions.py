"""Success of absolute actions in LIBERO's own environment, compared with the deltas of the same trajectories.

    nice -n 10 python benchmarks/absolute_actions.py data/starter [--limit 10] [--deltas] [--double]

The folder belongs to a run whose stages ``plan`` and ``replay`` are finished. Each kept trajectory starts where its
replay started, settles, and gets its actions as goals of the controller, rounded to float32 as in the datasets:
robosuite executes them with ``use_delta = False``. ``--deltas`` executes the deltas instead, ``--double`` does not
round. The name of each trajectory that misses the goal is printed. The last line is JSON: trajectories tried and
successful, and the largest distances (median and maximum over trajectories) between the two paths of the hand.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from repeat_in_libero import STEP_S, Done, of_run, opened, put_in

from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.controller_goals import absolute_actions, first_posture
from pipeline.scenes.compiled import CompiledScene, GripPose, grip_pose
from pipeline.types import Floats, Scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="a run's folder")
    parser.add_argument("--limit", type=int, help="trajectories; all when left out")
    parser.add_argument("--deltas", action="store_true", help="execute the deltas instead of their goals")
    parser.add_argument("--double", action="store_true", help="execute the actions without rounding them to float32")
    arguments = parser.parse_args()
    env, task = None, None
    distances_m, tried, reached = [], 0, 0
    for done in islice(of_run(arguments.data), arguments.limit):
        if task != done.task:
            env = opened(done.task)
        task = done.task
        first_grip, grips = replayed_grips(done.scene, done.states)
        actions = done.actions if arguments.deltas else absolute_actions(done.actions, first_grip, grips[:-1])
        if not arguments.double:
            actions = actions.astype(np.float32).astype(float)
        success, hand_m = executed(env, done, actions, use_delta=arguments.deltas)
        replayed_m = np.stack([grip.position_m for grip in grips[1:]])
        distance_m = float(np.linalg.norm(hand_m - replayed_m, axis=1).max())
        tried, reached = tried + 1, reached + success
        distances_m.append(distance_m)
        if not success:
            print(f"{done.name} ({done.what}, {task.suite}/{task.name}) misses the goal")
        print(f"{tried} done", file=sys.stderr)
    figures: dict[str, object] = {"tried": tried, "successful": reached}
    figures |= {"hand_apart_m": {"median": float(np.median(distances_m)), "max": max(distances_m)}}
    print(json.dumps(figures))


def replayed_grips(scene: Scene, states: Iterable[Floats]) -> tuple[GripPose, list[GripPose]]:
    """Compile a scene, and return the grip's pose in ``first_posture`` and in each flattened state (S,)."""
    compiled = CompiledScene(scene)
    grips = []
    for state in (first_posture(scene, compiled.model), *states):
        compiled.restore(state)
        grips.append(grip_pose(compiled.data))
    return grips[0], grips[1:]


def executed(env: Any, done: Done, actions: Floats, *, use_delta: bool) -> tuple[bool, Floats]:
    """Execute goals or deltas (K, 7).

    Returns:
        True if the goal of the task is reached, and the positions of the hand (K, 3) in m.
    """
    put_in(env, done.scene)
    for _ in range(round((done.states[0, 0] - done.scene.state[0]) / STEP_S)):
        env.step([0.0] * 6 + [-1.0])
    assert np.array_equal(env.get_sim_state(), done.states[0]), "another first state"
    controller = env.env.robots[0].controller
    controller.use_delta = use_delta
    positions_m = []
    for number, action in enumerate(actions, 1):
        push = done.scene.start.push
        if push is not None:
            acts = push.first_step < number <= push.first_step + push.steps
            env.sim.data.xfrc_applied[env.sim.model.body_name2id(push.body)] = push.wrench if acts else 0.0
        env.step(action)
        # After a step, sites are those of one substep before: 2 ms, or 2 mm at 1 m/s.
        positions_m.append(env.sim.data.get_site_xpos("gripper0_grip_site").copy())
    controller.use_delta = True
    return bool(env.check_success()), np.stack(positions_m)


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
