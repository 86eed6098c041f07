"""What must hold of a run's manifest as a whole, and of what OpenVLA-OFT trains on: functions that say what is off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.clients import oft_check
from pipeline.files import read_json
from pipeline.formats.base import Row
from pipeline.formats.read_back import Fault
from pipeline.planning import plan
from pipeline.run import outcome
from pipeline.run.counts import by_axis_and_suite


def counts(data: Path, rows: Sequence[Row]) -> Iterator[Fault]:
    """Every planned row in the manifest; no quota overfilled, and none left open while candidates are left."""
    planned = [row.episode_id for row in plan.read(data / "plan.parquet")]
    if planned != [row["episode_id"] for row in rows]:
        yield Fault("manifest", None, f"{len(rows)} rows", f"the {len(planned)} of the plan, in its order")
    quotas: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        quotas[row["axis"], row["suite"], row["task"]].append(row)
    for (axis, suite, task), members in quotas.items():
        wanted = sum(row["wanted"] for row in members)
        kept = sum(row["kept"] or row["reason"] == outcome.LEFT_OUT for row in members)
        left = any(row["reason"] in ("reserve_not_needed", "not_replayed") for row in members)
        if kept > wanted or (kept < wanted and left):
            yield Fault("manifest", None, f"{kept} episodes of {axis} for {suite}/{task}", f"{wanted}")
    if read_json(data / "counts.json") != by_axis_and_suite(rows):
        yield Fault("manifest", None, "counts.json does not follow from the rows", "the counts that do")


def openvla_oft(statistics: Mapping[str, Any], folder: Path) -> list[Fault]:
    """What would mislead OpenVLA-OFT."""
    name = folder.parent.name
    if name not in statistics:
        return [Fault("rlds", None, f"dataset_statistics.json has nothing on {name}", "its statistics")]
    found = oft_check.check(folder, statistics[name])
    return [Fault("rlds", None, f"{name}: {what}", "what OpenVLA-OFT trains on") for what in found["violations"]]
