"""Rollout of one episode: a policy acts in an environment until the episode is over."""

from typing import Any

from pipeline.evaluation.actions import checked_actions
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.policies import Policy, Wanted
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.types import Frame

FILM_STEPS = 8
"""Largest number of steps between two frames of a video, even if the policy observes less often or not at all."""


def roll_out_policy(
    environment: EpisodeEnvironment, policy: Policy, task: EvaluationTask, film: dict[int, Frame] | None = None
) -> None:
    """Run one episode to its end; the environment has the result.

    Args:
        film: dictionary that receives agent views: number of steps before a view to the view. It receives the view of
            every observation, and a view after each ``FILM_STEPS`` steps without an observation.

    Raises:
        PolicyError: if the policy's answer is not actions.
        PipelineError: if the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)

    def look(wanted: Wanted) -> dict[str, Any]:
        """Return an observation, and add its agent view to the film."""
        observation = environment.observation(wanted)
        if film is not None and wanted.images:
            film[environment.progress.steps] = observation["images"]["agentview"]
        return observation

    while not progress.over:
        for action in checked_actions(policy.act(look), policy.name):
            steps = environment.progress.steps
            if film is not None and steps - max(film, default=-FILM_STEPS) >= FILM_STEPS:
                film[steps] = environment.image("agentview")
            progress = environment.step(action)
            if progress.over:
                break
    policy.end(progress.success)
