"""How many of LIBERO-Plus's pose and robot tasks a tracked replay of the starter demonstration solves.

    nice -n 10 python benchmarks/tracked_tests.py [--task 'libero_goal/turn_on*'] [--axis pose robot] [--per-task 12]

It is what the generator can teach of them: a dataset holds what such replays do, from other starts. Each runs in the
test task's own environment and knows where objects stand; nothing of it is stored or trained on. The last line is JSON:
for each axis and task how the episodes end.
"""

import argparse
import json
from collections import Counter, defaultdict
from functools import lru_cache
from itertools import chain, repeat

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np

from pipeline.config import ReplayConfig
from pipeline.errors import RefusedError
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task, select_tasks
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay
from pipeline.physics.tracking import Route, follow

REST_STEPS = 10
"""Control steps after the last action: what was let go may still have to come to rest."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", nargs="+", default=["libero_[!9]*/*"], help="patterns of <suite>/<task>")
    parser.add_argument("--axis", nargs="+", default=["pose", "robot"], help="of LIBERO-Plus's tasks (both)")
    parser.add_argument("--per-task", type=int, default=3, help="test tasks of each task and axis (3)")
    arguments = parser.parse_args()
    environment = EpisodeEnvironment()
    ended: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for task in select_tasks(arguments.task):
        for axis in arguments.axis:
            tests = Selection(
                source="libero_plus", suites=(task.suite,), tasks=(task.name,), axes=(axis,), subset=arguments.per_task
            )
            ended[axis][f"{task.suite}/{task.name}"].update(solve(environment, test) for test in select(tests))
            print(axis, task.name, dict(ended[axis][f"{task.suite}/{task.name}"]), flush=True)
    environment.close()
    print(json.dumps(ended))


def solve(environment: EpisodeEnvironment, test: EvaluationTask) -> str:
    """How an episode ends in which the demonstration is tracked."""
    known = reference(test.suite, test.base)
    if known is None:
        return "no_reference"
    if environment.reset(test).over:
        return environment.progress.reason
    simulator = environment.simulator
    try:
        poses = {name: simulator.pose(name) for name in (*known.poses, *known.places)}
        tracked = follow(Route.through(known, simulator.hand, poses), lambda: simulator.hand, simulator.pose)
        resting = np.array([0.0] * 6 + [known.actions[-1, 6]])
        for action in chain(tracked, repeat(resting, REST_STEPS)):
            if environment.step(action).over:
                break
    except RefusedError as error:
        return error.reason
    return "success" if environment.progress.success else "goal_not_reached"


@lru_cache
def reference(suite: str, name: str) -> Reference | None:
    """What is tracked: the demonstration's own actions, settled or else as they were recorded, where they reach the
    goal."""
    task = find_task(suite, name)
    environment = Environment(task)
    try:
        for settle_steps in (ReplayConfig().settle_steps, 0):
            config = ReplayConfig(mode="open_loop", settle_steps=settle_steps)
            trajectory = replay(environment, StarterSource().of(task), name, config)
            if trajectory.verdict.kept:
                return Reference.of(trajectory.model_xml, trajectory.states, trajectory.actions)
    finally:
        environment.close()
    return None


if __name__ == "__main__":
    main()
