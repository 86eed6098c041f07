"""Stage export_lerobot: the kept episodes as a LeRobot v3.0 dataset, and as v2.1 where that is asked for."""

from pipeline.config import Config
from pipeline.formats.registry import formats_of
from pipeline.run.export import export_run
from pipeline.run.stage import main


def run(config: Config) -> None:
    for target in formats_of(config.data, config.export, config.render.extras):
        if target.stage_record == config.data / "lerobot.json":
            export_run(target, config)


if __name__ == "__main__":
    main(run, __doc__)
