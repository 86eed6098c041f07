"""One rollout: a policy acts in an episode until it is over."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from pipeline.axes import to_json
from pipeline.evaluation.episode import EpisodeEnvironment
from pipeline.evaluation.policies import Policy, checked_actions
from pipeline.evaluation.results import Row
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.types import Frame

FILM_STEPS = 8
"""A video has a frame of at most so many steps, also where the policy looks less often, or at nothing."""


def roll_out_policy(
    environment: EpisodeEnvironment,
    policy: Policy,
    task: EvaluationTask,
    film: dict[int, Frame] | None = None,
) -> Row:
    """Run one episode to its end; returns what is recorded of it.

    Args:
        film: where agent views go, by the number of steps before each: of every look, and one whenever
            ``FILM_STEPS`` went by without a look at it.

    Raises:
        PolicyError: when the policy answers with anything but actions.
        PipelineError: when the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)
    looks = 0

    def look(wanted: Any) -> dict[str, Any]:
        nonlocal looks
        looks += 1
        observation = environment.observation(wanted)
        if film is not None and wanted.images:
            film[environment.progress.steps] = observation["images"]["agentview"]
        return observation

    def record() -> None:
        steps = environment.progress.steps
        if film is not None and steps - max(film, default=-FILM_STEPS) >= FILM_STEPS:
            film[steps] = environment.image("agentview")

    while not progress.over:
        for action in checked_actions(policy.act(look), policy.name):
            record()
            progress = environment.step(action)
            if progress.over:
                break
    policy.end(progress.success)
    changes = environment.perturbations
    row = asdict(task)
    if task.source == "own" and changes:
        row["component"] = "+".join(change.component for change in changes)
    return {
        **row,
        "success": progress.success,
        "reason": progress.reason,
        "steps": progress.steps,
        "looks": looks,
        "prompt": environment.instruction,
        "perturbations": json.loads(to_json(changes)) if task.source == "own" else [],
    }
