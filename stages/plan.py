"""Stage plan: draw every perturbation of the run and write the plan, one row for each wanted episode."""

import sys

from pipeline.planning import plan
from pipeline.run import dropped, plan_stage
from pipeline.run.run import Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    rows = plan_stage.make(run.config)
    dropped.refuse_unasked(rows, run)
    for axis, number in plan.shortage(rows, run.config.plan).items():
        print(
            f"{axis}: {number} of {run.config.plan.episodes[axis]} wanted episodes cannot be planned, as no more "
            "different draws are left; use more demonstrations or ask for fewer",
            file=sys.stderr,
        )
    plan_stage.write(rows, run)
    trajectories = len({row.trajectory_id for row in rows})
    print(f"planned {sum(row.wanted for row in rows)} episodes from {trajectories} trajectories")


if __name__ == "__main__":
    main(run, __doc__)
