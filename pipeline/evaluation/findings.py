"""All that a report of evaluations says, as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from pipeline.evaluation.comparison import compare, paired
from pipeline.evaluation.merging import Evaluated
from pipeline.evaluation.paper_table import paper_table
from pipeline.evaluation.results import Row, success_rate, summary

SOURCES = ("libero_plus", "own", "libero")
"""Of tasks, in a report's order; others follow."""

FAILURES = 3
"""So many are shown of each policy, source and axis."""

_FACTS = ("episode", "source", "suite", "name", "axis", "component", "level", "prompt", "reason", "steps", "looks")


def findings(policies: Sequence[Evaluated]) -> dict[str, Any]:
    """The findings, JSON-serialisable.

    Returns:
        ``policies``: name to settings, versions, number of refused episodes, ``overall``: the ``success_rate`` of all
        its episodes, and ``results``: ``summary`` by source.
        ``paper_table``: see ``PaperTable``; None where no test task was run.
        ``comparisons``: each two policies on the episodes of a source that both ran, see ``compare``.
        ``common``: source to the number of episodes that all policies ran which ran any of it.
        ``failures``: episodes to show, and whether there is a video.
    """
    present = {row["source"] for policy in policies for row in policy.rows}
    sources = [*(source for source in SOURCES if source in present), *sorted(present.difference(SOURCES))]
    tested = {policy.name: rows for policy in policies if (rows := policy.of("libero_plus"))}
    return {
        "policies": {
            policy.name: {
                "settings": policy.settings,
                "versions": _versions(policy.rows),
                "refused": policy.refused,
                "overall": success_rate(policy.rows),
                "results": {source: summary(rows) for source in sources if (rows := policy.of(source))},
            }
            for policy in policies
        },
        "common": {source: _common([rows for policy in policies if (rows := policy.of(source))]) for source in sources},
        "paper_table": _plain(paper_table(tested)) if tested else None,
        "comparisons": [
            {"source": source, "first": one.name, "second": other.name, **compare(pairs)}
            for source in sources
            for one, other in combinations(policies, 2)
            if (pairs := paired(one.of(source), other.of(source)))
        ],
        "failures": [
            {"policy": policy.name, "video": row["episode"] in policy.videos, **{name: row[name] for name in _FACTS}}
            for policy in policies
            for row in _shown_failures(policy)
        ],
    }


def _common(rows: Sequence[Sequence[Row]]) -> int:
    return len(set.intersection(*({(row["suite"], row["name"], row["seed"]) for row in group} for group in rows)))


def _shown_failures(policy: Evaluated) -> list[Row]:
    """Of each source and axis those with a video first, then the weakest perturbations, then by name."""
    failed = [row for row in policy.rows if not row["success"]]
    failed.sort(key=lambda row: (row["axis"], row["episode"] not in policy.videos, row["level"], row["episode"]))
    taken: Counter[tuple[str, str]] = Counter()
    shown = []
    for row in failed:
        taken[row["source"], row["axis"]] += 1
        if taken[row["source"], row["axis"]] <= FAILURES:
            shown.append(row)
    return shown


def _versions(rows: Sequence[Row]) -> dict[str, list[str]]:
    """Package, and what rendered, to its versions; several where machines differ."""
    names = dict.fromkeys(name for row in rows for name in row["versions"])
    return {name: sorted({row["versions"][name] for row in rows if name in row["versions"]}) for name in names}


def _plain(value: Any) -> Any:
    """Named tuples as objects, by the names of their fields."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: _plain(field) for name, field in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
