"""What of a run's finished work this version, or this machine, would make anew: see ``identity.refuse_unasked``.

Counted are finished files of today's plan, with today's settings, that were made with other recipes, packages, machine
code or another OpenGL device. A changed configuration or plan wants new files, and nobody is asked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pipeline.config import Config
from pipeline.planning.plan import Row
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore


def outdated(rows: Sequence[Row], config: Config, device: str | None = None) -> Counter[str]:
    """What of a plan's stored work would be made anew, and why, to the number of files.

    Args:
        rows: the plan.
        config: of the run.
        device: what renders here, as OpenGL names it; without it, frames of any device count as finished.
    """
    planned = dict.fromkeys(row.trajectory_id for row in rows)
    found: Counter[str] = Counter()
    for what, reasons in (
        ("trajectories", TrajectoryStore(config.data / "trajectories").outdated(planned)),
        ("files of frames", FrameStore(config.data / "frames", config.render).outdated_of(planned, device)),
    ):
        found.update({f"{what}, made with {reason}": number for reason, number in reasons.items()})
    return found
