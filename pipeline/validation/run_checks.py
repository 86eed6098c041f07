"""What must hold of a run's manifest as a whole, and of what OpenVLA-OFT trains on: functions that say what is off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.files import checksum, read_json
from pipeline.formats.base import Fault, Format, Row
from pipeline.run import manifest, plan
from pipeline.validation import oft_check


def counts(data: Path, rows: Sequence[Row]) -> Iterator[Fault]:
    """Every planned row in the manifest; no quota overfilled, and none left open while candidates are left."""
    planned = [row.episode_id for row in plan.read(data / "plan.parquet")]
    if planned != [row["episode_id"] for row in rows]:
        yield Fault("manifest", None, f"{len(rows)} rows", f"the {len(planned)} of the plan, in its order")
    quotas: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        quotas[row["axis"], row["suite"], row["task"]].append(row)
    for (axis, suite, task), members in quotas.items():
        wanted, kept = sum(row["wanted"] for row in members), sum(row["kept"] for row in members)
        left = any(row["reason"] in ("reserve_not_needed", "not_replayed") for row in members)
        if kept > wanted or (kept < wanted and left):
            yield Fault("manifest", None, f"{kept} episodes of {axis} for {suite}/{task}", f"{wanted}")
    if read_json(data / "counts.json") != manifest.counts(rows):
        yield Fault("manifest", None, "counts.json does not follow from the rows", "the counts that do")


@dataclass(frozen=True)
class Written:
    """A file as the record of its dataset has it.

    Attributes:
        dataset: the format's name.
        file: where it lies.
        sha256: of what was written.
    """

    dataset: str
    file: Path
    sha256: str


def written(target: Format[Any]) -> list[Written]:
    """The files of a dataset.

    Raises:
        PipelineError: when it is not finished.
    """
    return [Written(target.name, target.folder / name, sha256) for name, sha256 in target.record().files.items()]


def unchanged(recorded: Written) -> list[Fault]:
    """Whether a file of a dataset still is what was written."""
    expected = f"what its checksum in {recorded.dataset}.json is of; delete it, and `dvc repro` makes it again"
    try:
        same = checksum(recorded.file) == recorded.sha256
    except OSError as error:
        return [Fault(recorded.dataset, None, f"{recorded.file} cannot be read ({error})", expected)]
    return [] if same else [Fault(recorded.dataset, None, f"{recorded.file} was changed", expected)]


def openvla_oft(statistics: Mapping[str, Any], folder: Path) -> list[Fault]:
    """What would mislead OpenVLA-OFT."""
    name = folder.parent.name
    if name not in statistics:
        return [Fault("rlds", None, f"dataset_statistics.json has nothing on {name}", "its statistics")]
    found = oft_check.check(folder, statistics[name])
    return [Fault("rlds", None, f"{name}: {what}", "what OpenVLA-OFT trains on") for what in found["violations"]]
