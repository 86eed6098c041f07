"""How many replays reach their goal, open-loop and in ``auto``, by suite, axis and level; and how smooth they are.

    nice -n 10 python benchmarks/replay_yield.py [--draws 1] [--axes initial_joints scene layout] [--levels 1 3 5]

Draws come from the planner, over the starter demonstrations; ``--folder`` keeps the trajectories, so that a run that
was stopped goes on where it was. The last line is the result as JSON.
"""

import argparse
import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
from rich.console import Console
from rich.table import Table

from pipeline.axes import from_json
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.evaluation.statistics import wilson
from pipeline.libero.tasks import SUITES, find_task
from pipeline.physics.quality import smoothness
from pipeline.physics.reference import Reference
from pipeline.planning import plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.types import Task

AXES: dict[str, tuple[str, dict[str, Any]]] = {
    "controller_posture": ("robot", {"components": ["controller_posture"]}),
    "initial_joints": ("robot", {"components": ["initial_joints"]}),
    "target": ("pose", {"components": ["target"]}),
    "scene": ("pose", {"components": ["scene"]}),
    "layout": ("layout", {}),
    "disturbance": ("disturbance", {}),
}
"""What is measured to its axis and the options of that."""
SATURATED = 0.93
"""The largest action that a demonstrator's input device gives is 0.9375."""

REPLAY = ReplayConfig(mode="auto")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES))
    parser.add_argument("--levels", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--draws", type=int, default=1, help="of each demonstration at each level")
    parser.add_argument("--tasks", nargs="+", default=[f"{suite}/*" for suite in SUITES[:4]])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--workers", type=int, help="one for each core when left out")
    arguments = parser.parse_args()
    demos = DemosConfig(tasks=tuple(arguments.tasks))
    entries, test = demos.index().entries, benchmark.load()
    rows: dict[str, plan.Row] = {}
    for measured, level in product(arguments.axes, arguments.levels):
        axis, options = AXES[measured]
        episodes = {axis: len(entries) * arguments.draws}
        axes = {axis: {"levels": [level], **options}}
        drawn = PlanConfig.model_validate({"seed": 1, "axes": axes, "episodes": episodes, "reserve": 0.0})
        rows |= {row.episode_id: row for row in plan.make(entries, drawn, REPLAY, test)}
    with (
        tempfile.TemporaryDirectory() as temporary,
        runner(ComputeConfig(workers=arguments.workers), Path("data")) as run,
    ):
        store = TrajectoryStore(arguments.folder or Path(temporary))
        Replays(demos, REPLAY, store.root, run).of(list(rows.values()))
        replayed = store.rows()
        lines = _lines(rows.values(), replayed)
        shapes = list(_shapes(rows.values(), replayed, store))
        displaced = _displaced_cm(rows.values(), replayed, store)
    _print(lines)
    print(json.dumps({"yields": lines, "smoothness": _medians(shapes), "displaced_cm": displaced}))


def _lines(rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A line for each axis and level. Draws that the scene refuses are counted apart, as they cost no replay."""
    reasons: dict[tuple[str, int], dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for row in rows:
        level: int = from_json(row.perturbations)[0].level if row.perturbations != "[]" else 0
        outcome = replayed[row.trajectory_id]
        reason, mode = outcome["reason"], outcome["mode"]
        if not outcome["steps"]:
            reason = f"refused: {reason}"
        elif reason == "kept":
            # In `auto`, what is kept as tracked has failed open-loop before.
            reason = mode
        measured = row.component if row.component in AXES else row.axis
        reasons[measured, level][row.suite][reason] += 1
    lines: list[dict[str, Any]] = []
    for (axis, level), by_suite in reasons.items():
        total = sum(by_suite.values(), Counter[str]())
        tried = sum(number for reason, number in total.items() if not reason.startswith("refused"))
        line: dict[str, Any] = {"axis": axis, "level": level, "tried": tried}
        for mode, kept in (("open_loop", ("open_loop",)), ("auto", ("open_loop", "tracked"))):
            number = sum(total[reason] for reason in kept)
            line[mode] = {"kept": number, "interval": _interval(number, tried)}
            for suite, of in by_suite.items():
                valid = sum(n for reason, n in of.items() if not reason.startswith("refused"))
                own = sum(of[reason] for reason in kept)
                line[mode] |= {suite: f"{own}/{valid}", f"{suite}_interval": _interval(own, valid)}
        line["dropped"] = {reason: n for reason, n in total.items() if reason not in ("open_loop", "tracked")}
        lines.append(line)
    return lines


def _shapes(
    rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]], store: TrajectoryStore
) -> Iterator[dict[str, float]]:
    """How each tracked replay compares with what the demonstrator did, as ratios."""
    twins = {row.demo_id: row.trajectory_id for row in rows if row.role == "twin"}
    for row in rows:
        outcome = replayed[row.trajectory_id]
        if outcome["kept"] and outcome["mode"] == "tracked":
            task = find_task(row.suite, row.task)
            own, twin = (_shape(store, one, task) for one in (row.trajectory_id, twins[row.demo_id]))
            ratios = {name: own[name] / twin[name] for name in own if name != "saturated"}
            yield ratios | {"saturated": own["saturated"], "saturated_twin": twin["saturated"]}


def _displaced_cm(
    rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]], store: TrajectoryStore
) -> dict[int, list[float]]:
    """Level of pushes to how far, at most, they put the hand from the twin's, until half a second after them.

    Tenth, fiftieth and ninetieth percentile of those that are kept.
    """
    twins = {row.demo_id: row.trajectory_id for row in rows if row.role == "twin"}
    found: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        if row.axis == "disturbance" and replayed[row.trajectory_id]["kept"]:
            pushed, twin = store.load(row.trajectory_id), store.load(twins[row.demo_id])
            push = pushed.scene.push
            assert push is not None
            steps = slice(push.first_step, min(push.first_step + push.steps + 10, len(twin.actions)))
            hands = [Reference.of(one.model_xml, one.states[steps], one.actions[steps]) for one in (pushed, twin)]
            away_m = np.linalg.norm(hands[0].positions_m - hands[1].positions_m, axis=1)
            found[int(row.level)].append(100 * float(away_m.max()))
    return {level: np.percentile(cm, [10, 50, 90]).round(1).tolist() for level, cm in sorted(found.items())}


@cache
def _shape(store: TrajectoryStore, trajectory_id: str, task: Task) -> dict[str, float]:
    trajectory = store.load(trajectory_id)
    arm = trajectory.actions[:, :6]
    return smoothness(trajectory, task) | {
        "action_change": float(np.sqrt((np.diff(arm, axis=0) ** 2).sum(axis=1).mean())),
        "saturated": float((np.abs(arm) > SATURATED).any(axis=1).mean()),
    }


def _medians(shapes: Sequence[dict[str, float]]) -> dict[str, float]:
    names = shapes[0] if shapes else ()
    return {"replays": len(shapes)} | {n: round(float(np.median([shape[n] for shape in shapes])), 3) for n in names}


def _interval(kept: int, tried: int) -> tuple[float, float]:
    low, high = wilson(kept, tried)
    return round(low, 3), round(high, 3)


def _print(lines: Sequence[Mapping[str, Any]]) -> None:
    table = Table("axis", "level", "mode", *SUITES[:4], "all", "95 %", "dropped")
    for line, mode in product(lines, ("open_loop", "auto")):
        of = line[mode]
        suites = [of.get(suite, "-") for suite in SUITES[:4]]
        kept = f"{of['kept']}/{line['tried']}"
        dropped = ", ".join(f"{reason} {number}" for reason, number in line["dropped"].items())
        table.add_row(line["axis"], str(line["level"]), mode, *suites, kept, str(of["interval"]), dropped)
    Console(stderr=True, width=180).print(table)


if __name__ == "__main__":
    main()
