"""Outcomes of policies on LIBERO-Plus's test tasks, from this project's evaluations or from another program."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from pipeline.evaluation.results import EpisodeResult, Evaluated, mixed_versions


class Outcome(NamedTuple):
    """Outcome of one episode on a test task.

    Attributes:
        suite, name: suite and name of the test task.
    """

    suite: str
    name: str
    success: bool


@dataclass(frozen=True)
class TestedPolicy:
    """Episodes of one policy on test tasks under one protocol.

    Attributes:
        name: the policy's name.
        outcomes: the episodes in which the policy acted.
        program: program that ran the episodes.
        prompt: kind of prompt, ``clean``, ``benchmark`` or ``blank``; ``other`` for further prompts, `None` if the
            results do not state it. Several kinds are joined by `` and ``.
        step_limits: suite to its step limits, in ascending order; empty if the results do not state them.
        left_out: number of episodes that have no outcome, because the scene was rejected or the program failed.
        black: views that were black, as the setting ``black``; several are joined by `` and ``.
        mixed_versions: name to the versions of the episodes, where they have several.
    """

    __test__ = False  # not a test case, whatever its name starts with

    name: str
    outcomes: Sequence[Outcome]
    program: str
    prompt: str | None
    step_limits: Mapping[str, tuple[int, ...]]
    left_out: int
    black: str = "none"
    mixed_versions: Mapping[str, Sequence[str]] = field(default_factory=dict)


def tested_policy(policy: Evaluated) -> TestedPolicy | None:
    """Return the outcomes of an evaluation on test tasks; `None` if it has no test task."""
    rows = policy.from_source("libero_plus")
    return tested_in(policy.name, rows) if rows else None


def tested_in(name: str, rows: Sequence[EpisodeResult]) -> TestedPolicy:
    """Return the outcomes of episodes on test tasks, as ``evaluate`` stores them.

    Args:
        name: the policy's name.
        rows: at least one episode.
    """
    outcomes = [Outcome(row.suite, row.name, row.success) for row in rows]
    programs = {str(row.settings.get("runner", "pipeline")) for row in rows}
    program = "evaluate" if programs == {"pipeline"} else " and ".join(sorted(programs))
    limits = limits_of((row.suite, row.step_limit) for row in rows)
    black = joined({str(row.settings.get("black", "none")) for row in rows})
    prompt = joined({row.prompt for row in rows})
    return TestedPolicy(name, outcomes, program, prompt, limits, 0, black, mixed_versions(rows))


def joined(kinds: Iterable[str]) -> str:
    """Join kinds of prompts, or of black views."""
    return " and ".join(sorted(kinds))


def limits_of(limits: Iterable[tuple[str, int]]) -> dict[str, tuple[int, ...]]:
    """Return suite to its step limits, from the suite and the limit of each episode."""
    by_suite: dict[str, set[int]] = {}
    for suite, limit in limits:
        by_suite.setdefault(suite, set()).add(limit)
    return {suite: tuple(sorted(by_suite[suite])) for suite in sorted(by_suite)}
