"""Results of fictitious episodes, and the command that reads them."""

from dataclasses import asdict
from typing import Any

from pipeline.commands.command_line import run
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.seeding import digest


def result(
    task: EvaluationTask, success: bool = False, policy: str = "p", prompt: Any = "clean", **fields: Any
) -> EpisodeResult:
    """Return a result under the settings of ``evaluate``; ``fields`` replace its fields."""
    limit = STEP_LIMITS[task.suite]
    row: dict[str, Any] = {
        **asdict(task),
        "episode": digest(str(task), policy, prompt)[:16],
        "prompt": prompt,
        "instruction": "turn on the stove",
        "step_limit": limit,
        "seed": 0,
        "success": success,
        "reason": "success" if success else "step_limit",
        "steps": 100 if success else limit,
        "looks": 12,
        "perturbations": [],
        "policy": policy,
        "identity": f"claimed:{policy}",
        "settings": {"prompt": prompt, "seed": 0},
        "versions": {"mujoco": "3.2.7", "OpenGL": "llvmpipe"},
    }
    return EpisodeResult(**{**row, **fields})


def analyze(*arguments: str) -> int:
    """Run the command ``analyze``; return its exit code."""
    return run(["analyze", *arguments])
