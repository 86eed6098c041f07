"""How many demonstrations still succeed among confounding objects, by their number, with reasons for the others.

    nice -n 10 python benchmarks/layout_yield.py [--sources libero robosuite sweethome3d] [--counts 1 3 5]

One draw for each of the 40 starter demonstrations and each count; the last line is the result as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from typing import get_args

from pipeline import seeding
from pipeline.axes.layout import LayoutAxis
from pipeline.config import ReplayConfig
from pipeline.demos import StarterSource
from pipeline.environment import Environment
from pipeline.objects import Source, models
from pipeline.replay import open_loop
from pipeline.tasks import SUITES, select_tasks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sources", nargs="+", choices=get_args(Source), default=["libero", "robosuite"])
    parser.add_argument("--counts", nargs="+", type=int, default=[1, 3, 5])
    parser.add_argument("--tasks", nargs="+", default=[f"{suite}/*" for suite in SUITES[:4]])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    axes = {
        count: LayoutAxis.model_validate({"levels": [count], "sources": arguments.sources})
        for count in arguments.counts
    }
    source, outcomes = StarterSource(), {name: Counter[str]() for name in ("base", *map(str, arguments.counts))}
    wanted = select_tasks(arguments.tasks)
    refused: Counter[str] = Counter()
    seconds: dict[str, list[float]] = {name: [] for name in outcomes}
    for number, task in enumerate(wanted, start=1):
        demo = source.load(source.index([task]).entries[0].demo_id)
        environment = Environment(task)
        base_kept = False
        for name in outcomes:
            draws = [
                axes[int(name)].sample(seeding.rng(arguments.seed, demo.demo_id, name), task, 0)
                for _ in range(name != "base")
            ]
            begun = time.perf_counter()
            trajectory = open_loop(environment, demo, name, ReplayConfig(), draws)
            seconds[name].append(time.perf_counter() - begun)
            reason = trajectory.verdict.reason
            if name == "base":
                base_kept = trajectory.verdict.kept
            elif not base_kept:
                reason += "_where_the_base_fails"
            outcomes[name][reason] += 1
            refused.update(json.loads(trajectory.resolved).get("layout", {}).get("rejected", {}))
            print(f"{number}/{len(wanted)} {task.suite}/{task.name} {name}: {reason} {seconds[name][-1]:.1f} s")
        environment.close()
    print(
        json.dumps(
            {
                "models": len(models(tuple(arguments.sources))),
                "outcomes": {name: dict(counts.most_common()) for name, counts in outcomes.items()},
                "places_refused": dict(refused.most_common()),
                "mean_s": {name: round(sum(taken) / len(taken), 2) for name, taken in seconds.items()},
            }
        )
    )


if __name__ == "__main__":
    main()
