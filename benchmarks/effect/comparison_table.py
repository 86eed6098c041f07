"""Success of each arm by axis, with intervals, and whether an arm differs from the first on the same episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from arms import provenance

from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.results import read as read_results
from pipeline.evaluation.statistics import compare, paired, success_rate

SOURCES = {"libero": "LIBERO's own tasks", "libero_plus": "LIBERO-Plus test tasks", "own": "own draws"}

Results = Mapping[str, Sequence[Sequence[EpisodeResult]]]
"""Arm to the rows of its policies, a policy for each seed, in the same order for all arms."""


def table(results: Results) -> list[dict[str, Any]]:
    """A line for each source and axis.

    Episodes of all seeds count alike. Those of two arms are paired seed by seed: the same task, initial state and draw.

    Returns:
        ``source``, ``axis``, ``arms`` (name to episodes, successes, rate and Wilson's 95 % interval), ``p_values``
        (name of each arm but the first to McNemar's exact test against the first), and ``differences`` (to its rate
        minus the first's, with the interval of ``compare``).
    """
    first = next(iter(results))
    present = {(row.source, row.axis) for row in _all(results[first])}
    lines = []
    for source, axis in sorted(present, key=lambda key: ([*SOURCES].index(key[0]), key[1])):
        of = {
            arm: [[row for row in rows if (row.source, row.axis) == (source, axis)] for rows in policies]
            for arm, policies in results.items()
        }
        compared = {
            arm: compare([pair for one, other in zip(of[first], policies, strict=True) for pair in paired(one, other)])
            for arm, policies in of.items()
            if arm != first
        }
        lines.append(
            {
                "source": source,
                "axis": axis,
                "arms": {arm: success_rate(_all(policies)) for arm, policies in of.items()},
                "p_values": {arm: found["all"]["p_value"] for arm, found in compared.items()},
                "differences": {arm: found["all"]["difference"] for arm, found in compared.items()},
            }
        )
    return lines


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """The lines as a table; rates in percent."""
    arms = list(lines[0]["arms"])
    heads = ["axis", "evaluated on", "episodes", arms[0]]
    heads += [head for arm in arms[1:] for head in (arm, "p")]
    rows = [heads, ["---"] * len(heads)]
    for line in lines:
        cells = [line["axis"], SOURCES[line["source"]], str(line["arms"][arms[0]]["episodes"])]
        for arm in arms:
            rate = line["arms"][arm]
            cells.append(f"{100 * rate['rate']:.0f} % ({100 * rate['low']:.0f}-{100 * rate['high']:.0f})")
            if arm in line["p_values"]:
                cells.append(f"{line['p_values'][arm]:.2g}")
        rows.append(cells)
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def read(evaluations: Path, policies: Mapping[str, Sequence[str]]) -> Results:
    """The results of each arm's policies, by the names of these.

    Raises:
        PipelineError: when a policy has none.
    """
    return {
        arm: [[row for policy in read_results([evaluations / name]) for row in policy.rows] for name in names]
        for arm, names in policies.items()
    }


def contents(dataset: Path) -> dict[str, int]:
    """Axis to the number of episodes in an arm's dataset."""
    return dict(Counter(row["axis"] for row in provenance(dataset)))


def _all(policies: Sequence[Sequence[EpisodeResult]]) -> list[EpisodeResult]:
    return [row for rows in policies for row in rows]
