"""Stage export_lerobot: the kept episodes as a LeRobot v3.0 dataset, and as v2.1 where that is asked for."""

from pipeline.config import Config
from pipeline.formats.lerobot import LeRobot
from pipeline.formats.lerobot_v21 import LeRobotV21
from pipeline.run.cleaning import say_stale
from pipeline.run.export import export_run
from pipeline.run.stage import main


def run(config: Config) -> None:
    export_run(LeRobot, config)
    if config.export.lerobot_v21 is not None:
        export_run(LeRobotV21, config)
    say_stale("lerobot", config)


if __name__ == "__main__":
    main(run, __doc__)
