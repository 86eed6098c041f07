"""Share of replays that reach their goal, open-loop and in ``auto``, by suite, axis and level; and their smoothness.

    nice -n 10 python benchmarks/replay_yield.py [--draws 1] [--axes initial_joints scene layout] [--levels 1 3 5]

The planner samples the perturbations, over the starter demonstrations. ``--folder`` keeps the trajectories; a stopped
run resumes from them. The last line is the result as JSON.
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

import numpy as np
from rich.console import Console
from rich.table import Table

from pipeline.axes import from_json
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.evaluation.statistics import wilson
from pipeline.libero.tasks import SUITES, find_task
from pipeline.machine_code import ensure_fixed_machine_code
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
"""Name of a measurement to its axis and the axis's options."""
SATURATED = 0.93
"""Smallest action that counts as saturated; a demonstrator's input device gives at most 0.9375."""

REPLAY = ReplayConfig(mode="auto")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES))
    parser.add_argument("--levels", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--draws", type=int, default=1, help="samples of each demonstration at each level")
    parser.add_argument("--tasks", nargs="+", default=[f"{suite}/*" for suite in SUITES[:4]])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--workers", type=int, help="number of workers; one for each core by default")
    arguments = parser.parse_args()
    demos = DemosConfig(tasks=tuple(arguments.tasks))
    entries, test = demos.index().entries, benchmark.load()
    rows: dict[str, plan.Row] = {}
    for measured, level in product(arguments.axes, arguments.levels):
        axis, options = AXES[measured]
        episodes = {axis: len(entries) * arguments.draws}
        axes = {axis: {"levels": [level], **options}}
        plan_config = PlanConfig.model_validate({"seed": 1, "axes": axes, "episodes": episodes, "reserve": 0.0})
        rows |= {row.episode_id: row for row in plan.make(entries, plan_config, REPLAY, test)}
    with (
        tempfile.TemporaryDirectory() as temporary,
        runner(ComputeConfig(workers=arguments.workers), Path("data")) as run,
    ):
        store = TrajectoryStore(arguments.folder or Path(temporary))
        Replays(demos, REPLAY, store, run).complete(list(rows.values()))
        replayed = store.rows()
        lines = _lines(rows.values(), replayed)
        shapes = list(_shapes(rows.values(), replayed, store))
        displaced = _displaced_cm(rows.values(), replayed, store)
    _print(lines)
    print(json.dumps({"yields": lines, "smoothness": _medians(shapes), "displaced_cm": displaced}))


def _lines(rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a line for each axis and level.

    Perturbations that the scene rejects are counted separately, as they cost no replay.
    """
    reasons: dict[tuple[str, int], dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for row in rows:
        level: int = from_json(row.perturbations)[0].level if row.perturbations != "[]" else 0
        outcome = replayed[row.trajectory_id]
        reason, mode = outcome["reason"], outcome["mode"]
        if not outcome["steps"]:
            reason = f"refused: {reason}"
        elif reason == "kept":
            # In `auto`, a replay is tracked only after it has failed open-loop.
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
            for suite, of_suite in by_suite.items():
                valid = sum(n for reason, n in of_suite.items() if not reason.startswith("refused"))
                kept_in_suite = sum(of_suite[reason] for reason in kept)
                interval = _interval(kept_in_suite, valid)
                line[mode] |= {suite: f"{kept_in_suite}/{valid}", f"{suite}_interval": interval}
        line["dropped"] = {reason: n for reason, n in total.items() if reason not in ("open_loop", "tracked")}
        lines.append(line)
    return lines


def _shapes(
    rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]], store: TrajectoryStore
) -> Iterator[dict[str, float]]:
    """Return the ratios of each tracked replay's smoothness to that of its demonstration's clean twin."""
    twins = {row.demo_id: row.trajectory_id for row in rows if row.role == "twin"}
    for row in rows:
        outcome = replayed[row.trajectory_id]
        if outcome["kept"] and outcome["mode"] == "tracked":
            task = find_task(row.suite, row.task)
            tracked, twin = _shape(store, row.trajectory_id, task), _shape(store, twins[row.demo_id], task)
            ratios = {name: tracked[name] / twin[name] for name in tracked if name != "saturated"}
            yield ratios | {"saturated": tracked["saturated"], "saturated_twin": twin["saturated"]}


def _displaced_cm(
    rows: Iterable[plan.Row], replayed: Mapping[str, Mapping[str, Any]], store: TrajectoryStore
) -> dict[int, list[float]]:
    """Return level of pushes to the largest distance of the hand from the clean twin's hand, in cm.

    The time ends half a second after the push. The numbers are the tenth, fiftieth and ninetieth percentile of the kept
    episodes.
    """
    twins = {row.demo_id: row.trajectory_id for row in rows if row.role == "twin"}
    largest_cm: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        if row.axis == "disturbance" and replayed[row.trajectory_id]["kept"]:
            pushed, twin = store.load(row.trajectory_id), store.load(twins[row.demo_id])
            push = pushed.scene.start.push
            assert push is not None
            steps = slice(push.first_step, min(push.first_step + push.steps + 10, len(twin.actions)))
            hand_pushed = Reference.of(pushed.model_xml, pushed.states[steps], pushed.actions[steps])
            hand_twin = Reference.of(twin.model_xml, twin.states[steps], twin.actions[steps])
            away_m = np.linalg.norm(hand_pushed.positions_m - hand_twin.positions_m, axis=1)
            largest_cm[int(row.level)].append(100 * float(away_m.max()))
    return {level: np.percentile(cm, [10, 50, 90]).round(1).tolist() for level, cm in sorted(largest_cm.items())}


@cache
def _shape(store: TrajectoryStore, trajectory_id: str, task: Task) -> dict[str, float]:
    trajectory = store.load(trajectory_id)
    arm = trajectory.actions[:, :6]
    return smoothness(trajectory, task) | {
        "action_change": float(np.sqrt((np.diff(arm, axis=0) ** 2).sum(axis=1).mean())),
        "saturated": float((np.abs(arm) > SATURATED).any(axis=1).mean()),
    }


def _medians(shapes: Sequence[dict[str, float]]) -> dict[str, float]:
    medians: dict[str, float] = {"replays": len(shapes)}
    for name in shapes[0] if shapes else ():
        values = [shape[name] for shape in shapes]
        medians[name] = round(float(np.median(values)), 3)
    return medians


def _interval(kept: int, tried: int) -> tuple[float, float]:
    low, high = wilson(kept, tried)
    return round(low, 3), round(high, 3)


def _print(lines: Sequence[Mapping[str, Any]]) -> None:
    table = Table("axis", "level", "mode", *SUITES[:4], "all", "95 %", "dropped")
    for line, mode in product(lines, ("open_loop", "auto")):
        of_mode = line[mode]
        suites = [of_mode.get(suite, "-") for suite in SUITES[:4]]
        kept = f"{of_mode['kept']}/{line['tried']}"
        dropped = ", ".join(f"{reason} {number}" for reason, number in line["dropped"].items())
        table.add_row(line["axis"], str(line["level"]), mode, *suites, kept, str(of_mode["interval"]), dropped)
    Console(stderr=True, width=180).print(table)


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
