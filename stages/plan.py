"""Stage plan: draw every perturbation of the run and write the plan, one row for each wanted episode."""

import sys

from pipeline.config import Config
from pipeline.planning import plan
from pipeline.run.stage import main
from pipeline.testset import benchmark


def run(config: Config) -> None:
    index = config.demos.index()
    for problem in index.problems:
        print(f"left out: {problem.error}", file=sys.stderr)
    config.demos.refuse_tasks_without(index.entries)
    rows = plan.make(index.entries, config.plan, config.replay, benchmark.load())
    config.export.refuse_too_few(plan.demonstrations(rows))
    for axis, number in plan.shortage(rows, config.plan).items():
        print(
            f"{axis}: {number} of {config.plan.episodes[axis]} wanted episodes cannot be planned, as no more "
            "different draws are left; use more demonstrations or ask for fewer",
            file=sys.stderr,
        )
    plan.write(rows, config.data / "plan.parquet")
    trajectories = len({row.trajectory_id for row in rows})
    print(f"planned {sum(row.wanted for row in rows)} episodes from {trajectories} trajectories")


if __name__ == "__main__":
    main(run, __doc__)
