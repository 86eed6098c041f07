"""Content of a report of evaluations, as JSON: rates, the paper's table, comparisons, failures."""

from collections.abc import Sequence
from itertools import chain, combinations
from typing import Any

from pipeline.evaluation.analyses.tested import tested_policy
from pipeline.evaluation.results import EpisodeResult, Evaluated, mixed_versions, versions_of
from pipeline.evaluation.statistics import compare, paired, success_rate, summary
from pipeline.grouping import grouped
from pipeline.report.paper_table import table_of

SOURCES = ("libero_plus", "own", "libero")
"""Sources of tasks, in a report's order; other sources follow."""

FAILURES = 3
"""Number of failures shown of each policy, source and axis."""

_FACTS = ("episode", "source", "suite", "name", "axis", "component", "level", "instruction", "reason", "steps", "looks")


def findings(policies: Sequence[Evaluated]) -> dict[str, Any]:
    """Compute the findings of evaluations, JSON-serialisable.

    Returns:
        ``policies``: name to settings, versions, number of rejected episodes, ``overall``: the ``success_rate`` of all
        its episodes, and ``results``: ``summary`` by source.
        ``mixed_versions``: name to the versions of all policies, where they have several.
        ``paper_table``: see ``table_of``; `None` if no test task was run.
        ``comparisons``: each pair of policies on the episodes of a source that both ran, see ``compare``.
        ``common``: source to the number of episodes that all policies with results of the source ran.
        ``failures``: episodes to show, and whether there is a video.
    """
    present: set[str] = set()
    for policy in policies:
        present |= {row.source for row in policy.rows}
    sources = [*(source for source in SOURCES if source in present), *sorted(present.difference(SOURCES))]
    tested = [policy for policy in map(tested_policy, policies) if policy is not None]
    return {
        "policies": {policy.name: _policy_findings(policy, sources) for policy in policies},
        "common": {source: _common_trials(policies, source) for source in sources},
        "mixed_versions": mixed_versions(chain.from_iterable(policy.rows for policy in policies)),
        "paper_table": table_of(tested) if tested else None,
        "comparisons": _comparisons(policies, sources),
        "failures": _failures(policies),
    }


def _policy_findings(policy: Evaluated, sources: Sequence[str]) -> dict[str, Any]:
    results = {}
    overall = success_rate(policy.rows)
    for source in sources:
        rows = policy.from_source(source)
        if rows:
            results[source] = summary(rows)
    return {
        "settings": policy.settings,
        "versions": versions_of(policy.rows),
        "refused": policy.rejected,
        "overall": overall,
        "results": results,
    }


def _common_trials(policies: Sequence[Evaluated], source: str) -> int:
    """Count the trials of a source that are common to all policies with results of the source."""
    trials = []
    for policy in policies:
        rows = policy.from_source(source)
        if rows:
            trials.append({row.trial for row in rows})
    return len(set.intersection(*trials))


def _comparisons(policies: Sequence[Evaluated], sources: Sequence[str]) -> list[dict[str, Any]]:
    comparisons = []
    for source in sources:
        for first, second in combinations(policies, 2):
            pairs = paired(first.from_source(source), second.from_source(source))
            if pairs:
                comparisons.append({"source": source, "first": first.name, "second": second.name, **compare(pairs)})
    return comparisons


def _failures(policies: Sequence[Evaluated]) -> list[dict[str, Any]]:
    failures = []
    for policy in policies:
        for row in _shown_failures(policy):
            facts = {name: getattr(row, name) for name in _FACTS}
            failures.append({"policy": policy.name, "video": row.episode in policy.videos, **facts})
    return failures


def _shown_failures(policy: Evaluated) -> list[EpisodeResult]:
    """Choose failures of each source and axis: with a video first, then by level from the weakest, then by name."""
    failed = [row for row in policy.rows if not row.success]
    failed.sort(key=lambda row: (row.axis, row.episode not in policy.videos, row.level, row.episode))
    groups = grouped(((row.axis, row.source), row) for row in failed)
    return list(chain.from_iterable(group[:FAILURES] for group in groups.values()))
