"""Stage validate: reopen the datasets and the manifest, and stop where anything is off."""

from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import write_json
from pipeline.run import finished
from pipeline.run.run import Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    file = run.validation_file
    if finished.of_validate(run).holds():
        # `push` asks for checks that are no older than what they are about.
        file.touch()
        print(f"nothing has changed since the checks of {file} found nothing off")
        return
    from pipeline.validation.validate import validate

    with run.workers(renders=True) as workers:
        report = validate(run, workers)
    write_json(file, report)
    off = {check: found["findings"] for check, found in report.items() if found["findings"]}
    if off:
        first = next(iter(off.values()))[0]
        raise PipelineError(
            f"{first['what']}; findings in all: {', '.join(f'{check} {len(found)}' for check, found in off.items())}",
            where=f"{first['dataset']} {first['episode'] or ''}".strip(),
            expected=first["expected"],
            remedy=f"read {file}, correct the cause, and run `{MAKE_AGAIN}` again",
        )
    finished.of_validate(run).keep()
    print(f"{len(report)} checks found nothing off, see {file}")


if __name__ == "__main__":
    main(run, __doc__)
