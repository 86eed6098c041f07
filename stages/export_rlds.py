"""Stage export_rlds: the kept episodes as RLDS, a set for each suite, without TensorFlow."""

from pipeline.config import Config
from pipeline.formats.rlds import Rlds
from pipeline.run.cleaning import say_stale
from pipeline.run.export import export_run
from pipeline.run.stage import main


def run(config: Config) -> None:
    export_run(Rlds, config)
    say_stale("rlds", config)


if __name__ == "__main__":
    main(run, __doc__)
