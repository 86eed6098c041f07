"""Stage doctor: check the machine and the installation against what the run needs, and record what it begins with."""

from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.run.machine import same_machine
from pipeline.run.stage import main
from pipeline.validation import doctor


def run(config: Config) -> None:
    if doctor.run(config):
        raise PipelineError(
            "this machine cannot make the run",
            where=config.data,
            expected="no line above that begins with `fail`",
            remedy="do what such lines say at their end, and run again",
        )
    same_machine(config.data, doctor.trial())


if __name__ == "__main__":
    main(run, __doc__)
