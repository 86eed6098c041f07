"""Share of kept episodes of a finished run, by axis, component, level and task, with 95 % intervals.

    python benchmarks/run_yields.py data/RUN/manifest.parquet

The table lists the groups with a share below 80 %; the last line is JSON with all groups. Wilson's intervals assume
that episodes of one demonstration are independent. They are dependent if the demonstration itself cannot be repeated.
"""

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.axes import from_json
from pipeline.evaluation.statistics import wilson
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.run import manifest
from pipeline.run.counts import tried

LOW = 0.8
"""Share of kept episodes below which the table lists a group."""

Row = Mapping[str, Any]

GROUPS: dict[str, Callable[[Row], list[str]]] = {
    "axis": lambda row: [row["axis"]],
    "component": lambda row: [f"{made.axis} {made.component}" for made in from_json(row["perturbations"])],
    "level": lambda row: [f"{made.axis} {made.level}" for made in from_json(row["perturbations"])],
    "task": lambda row: [f"{row['suite']}/{row['task']}"],
}
"""Kind of group to a function that returns an episode's groups."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("manifest", type=Path)
    rows = tried(manifest.read(parser.parse_args().manifest))
    yields = {kind: _yields(rows, groups) for kind, groups in GROUPS.items()}
    table = Table("by", "group", "kept", "tried", "95 %", "dropped", title=f"kept in fewer than {LOW:.0%}")
    for kind, groups in yields.items():
        for name, row in groups.items():
            if row["kept"] < LOW * row["tried"]:
                dropped = ", ".join(f"{reason} {number}" for reason, number in row["dropped"].items())
                table.add_row(kind, name, str(row["kept"]), str(row["tried"]), str(row["interval"]), dropped)
    Console(stderr=True, width=180).print(table)
    print(json.dumps(yields))


def _yields(rows: Sequence[Row], groups: Callable[[Row], list[str]]) -> dict[str, dict[str, Any]]:
    members: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        for group in groups(row):
            members[group].append(row)
    yields = {}
    for group, episodes in sorted(members.items()):
        kept = sum(row["kept"] for row in episodes)
        dropped = Counter(row["reason"] for row in episodes if not row["kept"])
        interval = [round(end, 3) for end in wilson(kept, len(episodes))]
        yields[group] = {"kept": kept, "tried": len(episodes), "interval": interval, "dropped": dict(dropped)}
    return yields


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
