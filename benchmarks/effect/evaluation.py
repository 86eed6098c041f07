"""Evaluation of each policy: test tasks by ``python -m pipeline evaluate``, and its obedience to instructions.

Four tasks of one scene differ by the instruction alone. From the same initial states, the policy gets each instruction,
and the empty one. The result is the first of the four goals that it reaches.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from experiment import Experiment

from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.policies import Server, Wanted
from pipeline.evaluation.selection import INITIAL_STATES, Selection, select
from pipeline.evaluation.tasks import EvaluationTask, libero_task
from pipeline.files import read_json, write_json
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task
from pipeline.types import Task


def tested(experiment: Experiment) -> list[EvaluationTask]:
    """Select LIBERO's initial states and LIBERO-Plus's test tasks, equally many for each task of the experiment."""
    wanted = experiment.evaluation
    chosen: list[EvaluationTask] = []
    for task in experiment.tasks:
        suite, name = task.split("/")
        chosen += select(Selection(suites=(suite,), tasks=(name,), episodes=wanted.states))
        for axis, number in wanted.libero_plus.items():
            tests = Selection(source="libero_plus", suites=(suite,), tasks=(name,), axes=(axis,), subset=number)
            chosen += select(tests)
    return chosen


@dataclass(frozen=True)
class Telling:
    """Episode in which a policy gets an instruction, in a scene with several goals."""

    state: int
    instruction: str

    @property
    def file(self) -> str:
        return f"{self.state}_{self.instruction.replace(' ', '_')}.json"


def tellings(experiment: Experiment) -> list[Telling]:
    """Combine each instruction, and the empty one, with the last initial states of the first task."""
    instructions = [*(task.instruction for task in _tasks(experiment)), ""]
    states = range(INITIAL_STATES - experiment.evaluation.reading_states, INITIAL_STATES)
    return [Telling(state, text) for state, text in product(states, instructions)]


def tell(experiment: Experiment, address: str, folder: Path) -> list[dict[str, Any]]:
    """Run the episodes without results in the folder.

    Args:
        experiment: the experiment.
        address: address of the policy's model server.
        folder: folder of the results.

    Returns:
        A row for each episode: ``state``, ``instruction``, ``reached`` (the goal's task, or ``None``), ``steps``.
    """
    wanted = tellings(experiment)
    missing = [telling for telling in wanted if not (folder / telling.file).exists()]
    if missing:
        with runner(ComputeConfig(), folder, renders=True) as workers:
            job = partial(_tell, _tasks(experiment), address, folder)
            workers(job, [missing[::2], missing[1::2]], "reading, halves")
    return [read_json(folder / telling.file) for telling in wanted]


def _tasks(experiment: Experiment) -> list[Task]:
    return [find_task(*name.split("/")) for name in experiment.tasks]


def _tell(tasks: Sequence[Task], address: str, folder: Path, wanted: Sequence[Telling]) -> None:
    environment, policy = EpisodeEnvironment(), Server(address)
    goals = {task.name: bddl.read(task.bddl_file).goal for task in tasks}
    for telling in wanted:
        episode = libero_task(tasks[0], telling.state)
        progress = environment.reset(episode)
        policy.begin(episode)
        reached: list[str] = []

        def look(wanted: Wanted, instruction: str = telling.instruction) -> dict[str, Any]:
            return environment.observation(wanted) | {"task_description": instruction}

        while not (progress.over or reached):
            for action in policy.act(look):
                progress = environment.step(action)
                reached = [name for name, goal in goals.items() if environment.simulator.satisfies(goal)]
                if progress.over or reached:
                    break
        policy.end(progress.success)
        row = {"state": telling.state, "instruction": telling.instruction, "reached": next(iter(reached), None)}
        write_json(folder / telling.file, row | {"steps": progress.steps})
    policy.close()
    environment.close()
