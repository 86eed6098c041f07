"""Evaluation of each policy: test tasks by ``python -m pipeline evaluate``, and its obedience to instructions.

In one scene, tasks differ by the instruction alone. From the same initial states, the policy gets each instruction of
the scene, and the empty one. The result is the first of the scene's goals that it reaches. It also gets rewrites of
each task's instruction, each from another initial state. Their result is whether it reaches the goal of the task.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from experiment import Experiment
from instructions import Instruction, every_instruction, find_tasks, goals_in

from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.goals import resolve_goal
from pipeline.evaluation.held_out import ATTEMPTS, PlannedPerturbations, sample_perturbation
from pipeline.evaluation.model_server import Server
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.selection import INITIAL_STATES, Selection, select
from pipeline.evaluation.tasks import EvaluationTask, balanced, libero_task
from pipeline.files import read_json, write_json
from pipeline.libero.carried import carry, definition_of
from pipeline.testset import benchmark
from pipeline.types import Task

CANDIDATES_OF_A_TEST = 5
"""Number of candidates of each level for a test on a held-out perturbation."""


def tested(experiment: Experiment) -> list[EvaluationTask]:
    """Select LIBERO's initial states, test tasks of LIBERO-Plus, and held-out goals.

    Each task of the experiment has equally many of the first two.
    """
    wanted = experiment.evaluation
    chosen: list[EvaluationTask] = []
    for task in experiment.tasks:
        suite, name = task.split("/")
        chosen += select(Selection(suites=(suite,), tasks=(name,), episodes=wanted.states))
        for axis, number in wanted.libero_plus.items():
            tests = Selection(source="libero_plus", suites=(suite,), tasks=(name,), axes=(axis,), subset=number)
            chosen += select(tests)
    if wanted.held_out_goals:
        chosen += _held_out_goals(find_tasks(experiment.tasks), wanted.held_out_goals)
    return chosen


def held_out_tests(experiment: Experiment, trained: PlannedPerturbations) -> list[EvaluationTask]:
    """Select held-out perturbations of each task, equally for all arms.

    Each test has a sample that keeps its clearance from the episodes of all arms. Light has no clearance: only equal
    perturbations are avoided. ``evaluate --trained-on`` takes the first such sample that the scene accepts. Levels take
    turns as far as they have such samples: perturbations with many textures or objects rarely have one.

    Raises:
        PipelineError: if a task has too few such perturbations.
    """
    chosen: list[EvaluationTask] = []
    for task, (axis, number) in product(find_tasks(experiment.tasks), experiment.evaluation.held_out.items()):
        episodes = number * CANDIDATES_OF_A_TEST
        candidates = Selection(source="own", suites=(task.suite,), tasks=(task.name,), axes=(axis,), episodes=episodes)
        apart: list[EvaluationTask] = []
        for test in select(candidates):
            samples = (sample_perturbation(test, candidates.seed, attempt) for attempt in range(ATTEMPTS))
            if not all(trained.overlap(perturbation, task) for perturbation in samples):
                apart.append(test)
        if len(apart) < number:
            raise PipelineError(
                f"{len(apart)} held-out perturbations of {axis} are apart from all arms' episodes of {task.name}",
                where=f"evaluation.held_out.{axis}",
                expected=str(number),
                remedy=f"ask for at most {len(apart)}, or plan fewer textures or objects",
            )
        chosen += balanced(apart, number, candidates.seed)
    return chosen


def _held_out_goals(tasks: Sequence[Task], states: int) -> list[EvaluationTask]:
    """Select the goals that no plan carries to the scenes of the experiment."""
    asked: set[Hashable] = set()
    for instruction in every_instruction(tasks):
        if instruction.asked and instruction.kind == "held out":
            asked.add(definition_of(carry(instruction.asked, instruction.scene)).asked)
    suites = tuple(dict.fromkeys(task.suite for task in tasks))
    goals = select(Selection(source="goals", suites=suites, episodes=states))
    return [goal for goal in goals if resolve_goal(goal)[1] in asked]


@dataclass(frozen=True)
class InstructedEpisode:
    """Episode in which a policy gets an instruction from one of the scene's initial states."""

    instruction: Instruction
    state: int

    @property
    def file(self) -> str:
        asked = self.instruction.asked.name if self.instruction.asked else "nothing"
        return f"{self.instruction.scene.name}_{self.state}_{asked}.json"


def instructed_episodes(experiment: Experiment) -> list[InstructedEpisode]:
    """Combine each scene's instructions with its last initial states, and each task's rewrites with its first ones."""
    tasks, wanted = find_tasks(experiment.tasks), experiment.evaluation
    states = range(INITIAL_STATES - wanted.reading_states, INITIAL_STATES)
    episodes = [
        InstructedEpisode(instruction, state) for instruction, state in product(every_instruction(tasks), states)
    ]
    if not wanted.rewrite_states:
        return episodes
    for task in tasks:
        rewrites = _list_rewrites(task, wanted.libero_plus["language"])
        for state, text in enumerate(rewrites[: wanted.rewrite_states]):
            episodes.append(InstructedEpisode(Instruction(task, task, "rewrite", text), state))
    return episodes


def _list_rewrites(task: Task, number: int) -> list[str]:
    """List the rewrites in a number of LIBERO-Plus's tests of a task, which ``tested`` selects, too."""
    tests = select(
        Selection(source="libero_plus", suites=(task.suite,), tasks=(task.name,), axes=("language",), subset=number)
    )
    found = benchmark.load()
    return [str(found.find(test.suite, test.name).parameters["text"]) for test in tests]


def run_instructed_episodes(experiment: Experiment, address: str, folder: Path) -> list[dict[str, Any]]:
    """Run the episodes without results in the folder.

    Args:
        experiment: the experiment.
        address: address of the policy's model server.
        folder: folder of the results.

    Returns:
        A row for each episode: ``scene`` (name of its task), ``kind`` as in ``Instruction``, ``instruction`` (text),
        ``asked`` and ``reached`` (names of tasks, or ``None``), ``state``, ``steps``.
    """
    wanted = instructed_episodes(experiment)
    missing = [episode for episode in wanted if not (folder / episode.file).exists()]
    if missing:
        with runner(ComputeConfig(), folder, renders=True) as workers:
            job = partial(_run_some, find_tasks(experiment.tasks), address, folder)
            workers(job, [missing[::2], missing[1::2]], "reading, halves")
    return [read_json(folder / episode.file) for episode in wanted]


def _run_some(tasks: Sequence[Task], address: str, folder: Path, wanted: Sequence[InstructedEpisode]) -> None:
    environment, policy = EpisodeEnvironment(), Server(address)
    for instructed in wanted:
        instruction = instructed.instruction
        goals = goals_in(instruction.scene, tasks)
        if instruction.kind == "rewrite" and instruction.asked:
            # It is compared with episodes of ``evaluate``, which only end at the goal of their task.
            goals = {instruction.asked.name: goals[instruction.asked.name]}
        episode = libero_task(instruction.scene, instructed.state)
        progress = environment.reset(episode)
        policy.begin(episode)
        reached: list[str] = []

        def look(wanted: Wanted, text: str = instruction.text) -> dict[str, Any]:
            return environment.observation(wanted) | {"task_description": text}

        while not (progress.over or reached):
            for action in policy.act(look):
                progress = environment.step(action)
                reached = [name for name, goal in goals.items() if environment.simulator.satisfies(goal)]
                if progress.over or reached:
                    break
        policy.end(progress.success)
        row = {
            "scene": instruction.scene.name,
            "kind": instruction.kind,
            "asked": instruction.asked.name if instruction.asked else None,
            "state": instructed.state,
            "instruction": instruction.text,
            "reached": next(iter(reached), None),
            "steps": progress.steps,
        }
        write_json(folder / instructed.file, row)
    policy.close()
    environment.close()
