"""How many of a finished run's episodes were kept, by axis, component, level and task, with 95 % intervals.

    python benchmarks/run_yields.py data/RUN/manifest.parquet

The table lists what is kept in fewer than 80 %; the last line is all of it as JSON. Wilson's intervals take episodes of
one demonstration as independent, which they are not where the demonstration itself cannot be repeated.
"""

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
from rich.console import Console
from rich.table import Table

from pipeline.axes import from_json
from pipeline.evaluation.statistics import wilson
from pipeline.run import manifest
from pipeline.run.counts import tried

LOW = 0.8
"""What is kept less often is shown."""

Row = Mapping[str, Any]

GROUPS: dict[str, Callable[[Row], list[str]]] = {
    "axis": lambda row: [row["axis"]],
    "component": lambda row: [f"{made.axis} {made.component}" for made in from_json(row["perturbations"])],
    "level": lambda row: [f"{made.axis} {made.level}" for made in from_json(row["perturbations"])],
    "task": lambda row: [f"{row['suite']}/{row['task']}"],
}
"""Kind of group to the groups that an episode counts with."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("manifest", type=Path)
    rows = tried(manifest.read(parser.parse_args().manifest))
    yields = {kind: _yields(rows, groups) for kind, groups in GROUPS.items()}
    table = Table("by", "group", "kept", "tried", "95 %", "dropped", title=f"kept in fewer than {LOW:.0%}")
    for kind, groups in yields.items():
        for name, one in groups.items():
            if one["kept"] < LOW * one["tried"]:
                dropped = ", ".join(f"{reason} {number}" for reason, number in one["dropped"].items())
                table.add_row(kind, name, str(one["kept"]), str(one["tried"]), str(one["interval"]), dropped)
    Console(stderr=True, width=180).print(table)
    print(json.dumps(yields))


def _yields(rows: Sequence[Row], groups: Callable[[Row], list[str]]) -> dict[str, dict[str, Any]]:
    members: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        for group in groups(row):
            members[group].append(row)
    found = {}
    for group, those in sorted(members.items()):
        kept = sum(row["kept"] for row in those)
        dropped = Counter(row["reason"] for row in those if not row["kept"])
        interval = [round(end, 3) for end in wilson(kept, len(those))]
        found[group] = {"kept": kept, "tried": len(those), "interval": interval, "dropped": dict(dropped)}
    return found


if __name__ == "__main__":
    main()
