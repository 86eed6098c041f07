"""Stage doctor: check the machine and the installation against what the run needs, and record what it begins with."""

from importlib.metadata import PackageNotFoundError

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.run import finished, machine
from pipeline.run.run import Run
from pipeline.run.stage import main
from pipeline.validation import doctor


def run(run: Run) -> None:
    try:
        tried = finished.of_doctor(run, gl.choose().device).holds()
    except (PipelineError, PackageNotFoundError):
        # What is missing, the doctor's table says.
        tried = False
    if doctor.run(run, tried=tried):
        raise PipelineError(
            "this machine cannot make the run",
            where=run.folder,
            expected="no line above that begins with `fail`",
            remedy="do what such lines say at their end, and run again",
        )
    if not tried:
        machine.record(run, machine.trial().digests)
        finished.of_doctor(run, gl.choose().device).keep()
    if not tried or machine.known_speed(run) is None:
        machine.keep_speed(run, machine.trial().speed)


if __name__ == "__main__":
    main(run, __doc__)
