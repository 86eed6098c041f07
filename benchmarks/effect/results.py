"""What each policy did, as one small file a policy, which tables and plots are made from."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.rollout import RECORDED
from pipeline.files import read_json, replaced


@dataclass(frozen=True)
class PolicyResults:
    """Of one policy.

    Attributes:
        arm, seed: of its training.
        settings: of the experiment, and the tasks.
        made: hashes of data, sentences and policy, axes of the episodes, losses, packages, and what each step took.
        rows: episodes of test tasks.
        reading: rows of ``evaluation.tell``.
        black: ``task``, ``state`` and ``success`` from LIBERO's own states with both views black.
    """

    arm: str
    seed: int
    settings: dict[str, Any]
    made: dict[str, Any]
    rows: Sequence[EpisodeResult]
    reading: Sequence[dict[str, Any]]
    black: Sequence[dict[str, Any]] = ()

    def made_by(self) -> dict[str, Any]:
        """What has to be the same for policies to be compared."""
        return {
            "settings": self.settings,
            "sentences": self.made.get("sentences_sha256"),
            "packages": self.made.get("packages"),
            "versions": {k: v for row in self.rows[:1] for k, v in row.versions.items() if k not in RECORDED},
        }

    def write(self, folder: Path) -> Path:
        """Fields that are the same in all rows are written once."""
        rows = [asdict(row) for row in self.rows]
        common = {name: value for name, value in rows[0].items() if all(row[name] == value for row in rows)}
        columns = [name for name in rows[0] if name not in common]
        facts = {"arm": self.arm, "seed": self.seed, "settings": self.settings, "made": self.made, "common": common}
        head = ",\n".join(f'"{name}": {json.dumps(value)}' for name, value in facts.items())
        file = folder / f"{self.arm}_seed{self.seed}.json"
        with replaced(file) as temporary:
            temporary.write_text(
                f'{{{head},\n"columns": {json.dumps(columns)},\n'
                f'"rows": [\n{_lines([[row[name] for name in columns] for row in rows])}\n],\n'
                f'"reading": [\n{_lines(self.reading)}\n],\n"black": [\n{_lines(self.black)}\n]}}\n'
            )
        return file


def _lines(rows: Sequence[Any]) -> str:
    return ",\n".join(json.dumps(row) for row in rows)


def read(folder: Path) -> list[PolicyResults]:
    """All policies of a folder, in the order of the experiment's arms.

    Raises:
        PipelineError: when there is none, or two are of different experiments.
    """
    found = []
    for file in sorted(folder.glob("*.json")):
        content = read_json(file, "evaluate the policy again")
        columns, common = content.pop("columns"), content.pop("common")
        rows = [EpisodeResult(**common, **dict(zip(columns, row, strict=True))) for row in content.pop("rows")]
        found.append(PolicyResults(**content, rows=rows))
        first = found[0].made_by()
        for what, made_by in found[-1].made_by().items():
            if made_by != first[what]:
                raise PipelineError(
                    f"made by other {what} than the results beside it",
                    where=file,
                    expected="one experiment",
                    remedy="evaluate all policies under the same experiment, or delete those of the older one",
                )
    if not found:
        raise PipelineError("there are no results yet", where=folder, remedy="train and evaluate a policy first")
    arms = list(found[0].settings["arms"])
    return sorted(found, key=lambda one: (arms.index(one.arm), one.seed))
