"""The manifest: one row for every planned episode, kept or dropped and why, and where it lies in each dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from rich.table import Table

from pipeline.files import replaced
from pipeline.plan import Row
from pipeline.types import Verdict
from pipeline.versions import versions

SCHEMA_FILE = Path(__file__).parent.parent / "schemas" / "manifest.json"
"""Column names, types and meanings."""

_TYPES = {"string": pa.string(), "int": pa.int64(), "bool": pa.bool_()}


def build(
    rows: Sequence[Row],
    outcome: Mapping[str, Verdict],
    replayed: Mapping[str, tuple[str, int, str]],
    devices: Mapping[str, str],
    rlds: Mapping[str, tuple[str, int]],
    lerobot: Mapping[str, int],
) -> pa.Table:
    """Join the plan with what became of it.

    Args:
        rows: the plan.
        outcome: episode id to verdict.
        replayed: trajectory id to the mode used, the number of executed actions and what physics perturbations came to.
        devices: trajectory id to the OpenGL device that rendered it, for every rendered trajectory.
        rlds: episode id to its shard's file name and its place in it, for every kept episode.
        lerobot: episode id to its ``episode_index``, for every kept episode.
    """
    shared = {f"{name.replace('-', '_')}_version": version for name, version in versions().items()}
    table = []
    for row in rows:
        verdict = outcome[row.episode_id]
        mode, steps, resolved = replayed.get(row.trajectory_id, (None, None, None))
        shard, index = rlds.get(row.episode_id, (None, None))
        made: dict[str, Any] = {
            "kept": verdict.kept,
            "reason": verdict.reason,
            "replay_mode": mode,
            "steps": steps,
            "resolved": resolved,
            "gl_device": devices.get(row.trajectory_id),
            "rlds_shard": shard,
            "rlds_index": index,
            "lerobot_episode_index": lerobot.get(row.episode_id),
        }
        table.append(asdict(row) | made | shared)
    return pa.Table.from_pylist(table, schema=schema())


def schema() -> pa.Schema:
    """The manifest's columns, from ``schemas/manifest.json``."""
    columns = json.loads(SCHEMA_FILE.read_text())["columns"]
    return pa.schema([pa.field(c["name"], _TYPES[c["type"]], metadata={"meaning": c["meaning"]}) for c in columns])


def write(table: pa.Table, path: Path) -> None:
    with replaced(path) as temporary:
        pq.write_table(table, temporary)


def read(path: Path) -> list[dict[str, Any]]:
    return list(pq.read_table(path).to_pylist())


def counts(manifest: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, int]]]:
    """Axis to suite to the number of episodes planned, replayed and kept.

    A reserve counts as planned once it was needed, so that ``planned - kept`` is what was lost on the way.
    """
    table: dict[str, dict[str, dict[str, int]]] = {}
    for row in manifest:
        if row["reason"] == "reserve_not_needed":
            continue
        cell = table.setdefault(row["axis"], {}).setdefault(row["suite"], {"planned": 0, "replayed": 0, "kept": 0})
        cell["planned"] += 1
        cell["replayed"] += bool(row["steps"])
        cell["kept"] += row["kept"]
    return table


def counts_table(manifest: Sequence[Mapping[str, Any]]) -> Table:
    """``counts`` as a table for people, with a line of totals."""
    cells = counts(manifest)
    suites = list(dict.fromkeys(row["suite"] for row in manifest))
    table = Table(
        "axis", *(suite.removeprefix("libero_") for suite in suites), "all", title="planned/replayed/kept episodes"
    )
    for column in table.columns[1:]:
        column.justify, column.no_wrap = "right", True
    for axis, by_suite in cells.items():
        shown = [by_suite.get(suite, {}) for suite in suites]
        # A combination's name may break behind a +.
        table.add_row(axis.replace("+", "+ "), *map(_cell, shown), _cell(_sum(shown)))
    columns = [_sum([by_suite.get(suite, {}) for by_suite in cells.values()]) for suite in suites]
    table.add_section()
    table.add_row("all", *map(_cell, columns), _cell(_sum(columns)))
    return table


def _sum(cells: Sequence[Mapping[str, int]]) -> dict[str, int]:
    return {name: sum(cell.get(name, 0) for cell in cells) for name in ("planned", "replayed", "kept")}


def _cell(cell: Mapping[str, int]) -> str:
    return "/".join(map(str, cell.values())) or "-"
