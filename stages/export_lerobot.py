"""Stage export_lerobot: the kept episodes as a LeRobot v3.0 dataset, through lerobot itself."""

from pipeline.config import Config
from pipeline.formats.lerobot import LeRobot
from pipeline.run.export import export_run
from pipeline.run.stage import main


def run(config: Config) -> None:
    export_run(LeRobot, config)


if __name__ == "__main__":
    main(run, __doc__)
