"""Results of each policy in one small file; tables and plots are generated from these files."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.evaluation.results import RECORDED, EpisodeResult
from pipeline.files import read_json, replaced


@dataclass(frozen=True)
class PolicyResults:
    """Results of one policy.

    Attributes:
        arm, seed: arm and seed of its training.
        settings: settings of the experiment, and the tasks.
        made: hashes of data, sentences and policy; axes of the episodes, numbers of frames and of different
            demonstrations; losses; ``trained_with`` (packages and processors of the training, since 2026-11-29, and its
            precision, since 2026-11-30); packages of the evaluation; times of the steps.
        rows: episodes of test tasks.
        reading: rows of ``evaluation.run_instructed_episodes``.
        black: ``task``, ``state`` and ``success`` from LIBERO's own states with both views black.
    """

    arm: str
    seed: int
    settings: dict[str, Any]
    made: dict[str, Any]
    rows: Sequence[EpisodeResult]
    reading: Sequence[dict[str, Any]]
    black: Sequence[dict[str, Any]] = ()

    @property
    def precision(self) -> str:
        """Precision of the training; all results that do not state it have ``bfloat16``."""
        return str(self.made.get("trained_with", {}).get("precision", "bfloat16"))

    def made_by(self) -> dict[str, Any]:
        """Return the settings and versions that compared policies must share."""
        versions: dict[str, Any] = {}
        if self.rows:
            versions = {name: text for name, text in self.rows[0].versions.items() if name not in RECORDED}
        packages = self.made.get("packages")
        return {
            "settings": self.settings,
            "sentences": self.made.get("sentences_sha256"),
            "packages": packages,
            # Results before 2026-11-29 do not state the packages of the training.
            "packages of the training": self.made.get("trained_with", {}).get("packages", packages),
            "plans of all arms": self.made.get("plan_of_all_arms_sha256"),
            "versions": versions,
        }

    def write(self, folder: Path) -> Path:
        """Write the file, with the fields that are equal in all rows once; return its path."""
        rows = [asdict(row) for row in self.rows]
        common: dict[str, Any] = {}
        for name, value in rows[0].items():
            if all(row[name] == value for row in rows):
                common[name] = value
        columns = [name for name in rows[0] if name not in common]
        facts = {"arm": self.arm, "seed": self.seed, "settings": self.settings, "made": self.made, "common": common}
        table: list[list[Any]] = []
        for row in rows:
            table.append([row[name] for name in columns])
        head = ",\n".join(f'"{name}": {json.dumps(value)}' for name, value in facts.items())
        file = folder / f"{self.arm}_seed{self.seed}.json"
        with replaced(file) as temporary:
            temporary.write_text(
                f'{{{head},\n"columns": {json.dumps(columns)},\n'
                f'"rows": [\n{_lines(table)}\n],\n'
                f'"reading": [\n{_lines(self.reading)}\n],\n"black": [\n{_lines(self.black)}\n]}}\n'
            )
        return file


def _lines(rows: Sequence[Any]) -> str:
    return ",\n".join(json.dumps(row) for row in rows)


def read(folder: Path) -> list[PolicyResults]:
    """Read all policies of a folder, in the order of the experiment's arms.

    Raises:
        PipelineError: if the folder has no results, or results of different experiments.
    """
    policies: list[PolicyResults] = []
    for file in sorted(folder.glob("*.json")):
        content = read_json(file, "evaluate the policy again")
        columns, common = content.pop("columns"), content.pop("common")
        rows = [EpisodeResult(**common, **dict(zip(columns, row, strict=True))) for row in content.pop("rows")]
        policies.append(PolicyResults(**content, rows=rows))
        _reject_different(policies[0], policies[-1], policies[0].made_by(), file)
        _reject_other_precision(policies, policies[-1], file)
    if not policies:
        raise PipelineError("there are no results yet", where=folder, remedy="train and evaluate a policy first")
    settings = policies[0].settings
    arms = [*settings["arms"], *settings.get("further", ())]
    return sorted(policies, key=lambda policy: (arms.index(policy.arm), policy.seed))


def join(first: Sequence[PolicyResults], second: Sequence[PolicyResults], where: Path) -> list[PolicyResults]:
    """Join the policies of two experiments with different arms.

    Args:
        where: folder of the second experiment's results, for the message of an error.

    Raises:
        PipelineError: if an arm is in both experiments, or if sentences, packages or versions differ, or the precision
            under one seed.
    """
    arms = {policy.arm for policy in first}
    for policy in second:
        if policy.arm in arms:
            raise PipelineError(
                f"the arm {policy.arm} is in both compared experiments",
                where=where,
                expected="different arms",
                remedy="move the results of this arm to another folder",
            )
        _reject_different(first[0], policy, ("sentences", "packages", "packages of the training", "versions"), where)
        _reject_other_precision(first, policy, where)
    return [*first, *second]


def _reject_other_precision(others: Iterable[PolicyResults], policy: PolicyResults, where: Path) -> None:
    """Raise a ``PipelineError`` if a policy and another one of its seed were trained with different precision."""
    for other in others:
        if other.seed == policy.seed and other.precision != policy.precision:
            raise PipelineError(
                f"{policy.arm} was trained in {policy.precision}, and {other.arm} in {other.precision}, under the same "
                "seed",
                where=where,
                remedy="train the one in bfloat16 again, as new trainings are in float32",
            )


def _reject_different(first: PolicyResults, second: PolicyResults, names: Iterable[str], where: Path) -> None:
    """Raise a ``PipelineError`` if two policies differ in a setting or version of ``made_by``."""
    made_by_first, made_by_second = first.made_by(), second.made_by()
    for name in names:
        if made_by_first[name] != made_by_second[name]:
            raise PipelineError(
                f"{name} differ from those of the other compared results",
                where=where,
                expected="one experiment",
                remedy="evaluate all policies under the same experiment, or move the older results away",
            )
