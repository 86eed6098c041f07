"""Stage export_lerobot: the kept episodes as a LeRobot v3.0 dataset, and as v2.1 where that is asked for."""

from pipeline.formats.lerobot import LeRobot
from pipeline.formats.lerobot_v21 import LeRobotV21
from pipeline.run.cleaning import say_stale
from pipeline.run.export import export_run
from pipeline.run.run import Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    export_run(LeRobot, run)
    if run.config.export.lerobot_v21 is not None:
        export_run(LeRobotV21, run)
    say_stale("lerobot", run)


if __name__ == "__main__":
    main(run, __doc__)
