"""Verdicts on replays: a run keeps replays that succeed in the simulator and pass the section ``filter``."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.config import FilterConfig
from pipeline.libero.tasks import exceeds_step_limit
from pipeline.planning.plan import Row
from pipeline.types import Verdict

FAILURE_REASONS = ("goal_not_reached", "goal_lost")
"""Reasons of failures: replays that were simulated to the end and missed their goal.

Good demonstrations fail too: see the yields in docs/axes.md.
"""


def verdicts_of(
    stored: Mapping[str, Mapping[str, Any]], rows: Sequence[Row], limits: FilterConfig
) -> dict[str, Verdict]:
    """Map the id of every stored trajectory to its verdict.

    Args:
        stored: trajectory id to its row in the table of replays.
        rows: the plan, which has the suite of each trajectory. Steps of trajectories outside the plan are not limited.
        limits: the section ``filter``.
    """
    suite_of = {row.trajectory_id: row.suite for row in rows}
    return {name: _verdict(replayed, suite_of.get(name), limits) for name, replayed in stored.items()}


def _verdict(replayed: Mapping[str, Any], suite: str | None, limits: FilterConfig) -> Verdict:
    if not replayed["kept"]:
        return Verdict(False, replayed["reason"])
    fault = limits.fault(replayed)
    if fault is not None:
        return Verdict(False, fault)
    if limits.exceeds_step_limit and suite is not None and exceeds_step_limit(suite, replayed["steps"]):
        return Verdict(False, "exceeds_step_limit")
    return Verdict(True, replayed["reason"])
