"""Yield of LIBERO-Plus's pose and robot tasks for a tracked replay of the starter demonstration.

    nice -n 10 python benchmarks/tracked_tests.py [--task 'libero_goal/turn_on*'] [--axis pose robot] [--per-task 12]

The yield bounds the generator's contribution to these tasks: a dataset holds such replays, from other starts. Each
replay runs in the test task's own environment and knows the positions of objects. Nothing of it is stored or trained
on. The last line is JSON: the endings of the episodes for each axis and task.
"""

import argparse
import json
from collections import Counter, defaultdict
from functools import lru_cache
from itertools import chain, repeat

import numpy as np

from pipeline.config import ReplayConfig
from pipeline.errors import RejectedError
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task, select_tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay
from pipeline.physics.tracking import Route, follow

REST_STEPS = 10
"""Control steps after the last action, in which released objects come to rest."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", nargs="+", default=["libero_[!9]*/*"], help="patterns of <suite>/<task>")
    parser.add_argument("--axis", nargs="+", default=["pose", "robot"], help="axes of LIBERO-Plus's tasks (both)")
    parser.add_argument("--per-task", type=int, default=3, help="test tasks of each task and axis (3)")
    arguments = parser.parse_args()
    environment = EpisodeEnvironment()
    ended: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for task in select_tasks(arguments.task):
        for axis in arguments.axis:
            tests = Selection(
                source="libero_plus", suites=(task.suite,), tasks=(task.name,), axes=(axis,), subset=arguments.per_task
            )
            endings = ended[axis][f"{task.suite}/{task.name}"]
            endings.update(solve(environment, test) for test in select(tests))
            print(axis, task.name, dict(endings), flush=True)
    environment.close()
    print(json.dumps(ended))


def solve(environment: EpisodeEnvironment, test: EvaluationTask) -> str:
    """Track the demonstration in an episode; return the episode's ending."""
    tracked_reference = reference(test.suite, test.base)
    if tracked_reference is None:
        return "no_reference"
    if environment.reset(test).over:
        return environment.progress.reason
    simulator = environment.simulator
    try:
        names = (*tracked_reference.poses, *tracked_reference.places)
        poses = {name: simulator.pose(name) for name in names}
        route = Route.through(tracked_reference, simulator.hand, poses)
        tracked = follow(route, lambda: simulator.hand, simulator.pose)
        resting = np.array([0.0] * 6 + [tracked_reference.actions[-1, 6]])
        for action in chain(tracked, repeat(resting, REST_STEPS)):
            if environment.step(action).over:
                break
    except RejectedError as error:
        return error.reason
    return "success" if environment.progress.success else "goal_not_reached"


@lru_cache
def reference(suite: str, name: str) -> Reference | None:
    """Replay the demonstration's own actions as the reference, if they reach the goal.

    The replay with settling steps comes first; the second try replays the actions as recorded.
    """
    task = find_task(suite, name)
    environment = Environment(task)
    try:
        for settle_steps in (ReplayConfig().settle_steps, 0):
            config = ReplayConfig(mode="open_loop", settle_steps=settle_steps)
            trajectory = replay(environment, StarterSource().demonstration(task), name, config)
            if trajectory.verdict.kept:
                return Reference.of(trajectory.model_xml, trajectory.states, trajectory.actions)
    finally:
        environment.close()
    return None


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
