"""Files with lists of tasks, for ``evaluate --tasks-from``."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pipeline.errors import PipelineError
from pipeline.evaluation.held_out import digest_first_perturbations
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.outputs import write
from pipeline.seeding import digest


class TaskList(BaseModel):
    """Content of a file with a list of tasks.

    Attributes:
        seed: seed of the tasks' perturbations.
        draws: digest of all held-out perturbations; another version compares it to detect other perturbations. Stored
            lists have this name, a former term for perturbations.
        tasks: the tasks; in the file, tasks may have more fields, such as ``difficulty``.
    """

    seed: int
    draws: str = ""
    tasks: list[EvaluationTask]

    def digest_perturbations(self) -> str:
        """Compute ``draws`` with this version; empty without held-out perturbations."""
        digests = [digest_first_perturbations(task, self.seed) for task in self.tasks if task.source == "own"]
        return digest(*digests)[:16] if digests else ""


def read_tasks(file: Path, seed: int) -> list[EvaluationTask]:
    """Read the tasks that ``analyze construct`` or ``analyze grade`` listed.

    Raises:
        PipelineError: if the file is not such a list, or has perturbations of another seed or version.
    """
    try:
        listed = TaskList.model_validate_json(file.read_bytes())
        perturbations_digest = listed.digest_perturbations()
    except (OSError, ValueError, LookupError) as error:
        raise PipelineError(
            f"the file is not a list of tasks ({error})",
            where=file,
            expected="a file that `analyze construct` or `analyze grade` wrote",
            remedy="write the list again by one of these commands",
        ) from error
    if listed.seed != seed:
        raise PipelineError(
            f"these tasks were sampled under seed {listed.seed}, not {seed}", where=file, remedy=f"--seed {listed.seed}"
        )
    if listed.draws != perturbations_digest:
        raise PipelineError(
            "this version samples other perturbations for these tasks",
            where=file,
            expected="a list of this version",
            remedy="generate the list again with the same command, or evaluate with the version that generated it",
        )
    return listed.tasks


def write_tasks(listed: Iterable[EvaluationTask | dict[str, Any]], seed: int, file: Path) -> None:
    """Write a list of tasks that ``evaluate --tasks-from`` reads."""
    content = [task if isinstance(task, dict) else asdict(task) for task in listed]
    perturbations_digest = TaskList.model_validate({"seed": seed, "tasks": content}).digest_perturbations()
    lines = ",\n".join(map(json.dumps, content))
    write(file, f'{{"seed": {seed}, "draws": "{perturbations_digest}", "tasks": [\n{lines}\n]}}\n')
