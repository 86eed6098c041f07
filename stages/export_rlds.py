"""Stage export_rlds: the kept episodes as RLDS, a set for each suite, without TensorFlow."""

from pipeline.formats.rlds import Rlds
from pipeline.run.cleaning import say_stale
from pipeline.run.export import export_run
from pipeline.run.run import Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    export_run(Rlds, run)
    say_stale("rlds", run)


if __name__ == "__main__":
    main(run, __doc__)
