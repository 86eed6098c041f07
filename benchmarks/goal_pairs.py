"""Yields of the axis ``goal``: every pair of task and scene once, from LIBERO's starter demonstrations.

    nice -n 10 python benchmarks/goal_pairs.py [--suites SUITE ...] [--out FOLDER]

The demonstration of a task is replayed from one reset of the pair's scene, as in a run. Each pair prints its verdict;
``--out`` also stores the trajectories. The last line is JSON: suite to the pairs tried and kept, and reasons.
"""

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

from pipeline.axes.goal import GoalPerturbation, held_out_pairs, level_of_pair, usable
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.libero.tasks import SUITES
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.run.replay_job import ReplayJob


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--suites", nargs="+", default=list(SUITES))
    parser.add_argument("--out", type=Path, help="folder for the trajectories; a temporary one by default")
    parser.add_argument("--start", type=int, default=0, help="number of the reset (default: 0)")
    arguments = parser.parse_args()
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.out or Path(scratch)
        for suite in arguments.suites:
            found[suite] = yields(suite, arguments.start, folder)
    print(json.dumps(found))


def yields(suite: str, start: int, folder: Path) -> dict[str, object]:
    """Replay all pairs of a suite, and count them."""
    reasons: Counter[str] = Counter()
    settings = ReplayConfig()
    tried = usable(suite)
    for pair in sorted(tried, key=lambda pair: str(pair.task)):
        demos = DemosConfig(tasks=(str(pair.task),))
        (entry,) = demos.index().entries
        (twin,) = plan.twins([entry], 0, settings)
        ReplayJob(twin, twin.trajectory_id, demos, settings, folder)()
        change = GoalPerturbation(scene=pair.scene.name, start=start, level=level_of_pair(pair.task, pair.scene))
        row = plan.build_row(entry, [change], 0, settings)
        verdict = ReplayJob(row, twin.trajectory_id, demos, settings, folder)()
        reasons[verdict.reason] += 1
        held = " (held out)" if (pair.task, pair.scene) in held_out_pairs(suite) else ""
        print(f"{verdict.reason}: {pair.task} in {pair.scene.name}{held}", flush=True)
    return {"pairs": len(tried), "kept": reasons["kept"], "reasons": dict(reasons)}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
