"""Stage doctor: check the machine and the installation against what the run needs, and record what it begins with."""

from importlib.metadata import PackageNotFoundError

from pipeline import gl
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.run import finished, machine
from pipeline.run.stage import main
from pipeline.validation import doctor


def run(config: Config) -> None:
    try:
        tried = finished.of_doctor(config, gl.choose().device).holds()
    except (PipelineError, PackageNotFoundError):
        # What is missing, the doctor's table says.
        tried = False
    if doctor.run(config, tried=tried):
        raise PipelineError(
            "this machine cannot make the run",
            where=config.data,
            expected="no line above that begins with `fail`",
            remedy="do what such lines say at their end, and run again",
        )
    if not tried:
        machine.record(config.data, machine.trial().digests)
        finished.of_doctor(config, gl.choose().device).keep()
    if not tried or machine.known_speed(config.data) is None:
        machine.keep_speed(config.data, machine.trial().speed)


if __name__ == "__main__":
    main(run, __doc__)
