"""Stage validate: reopen the datasets and the manifest, and stop where anything is off."""

from pipeline.config import Config
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import write_json
from pipeline.run import finished
from pipeline.run.stage import main


def run(config: Config) -> None:
    file = config.data / "validation.json"
    if finished.of_validate(config).holds():
        # `push` asks for checks that are no older than what they are about.
        file.touch()
        print(f"nothing has changed since the checks of {file} found nothing off")
        return
    from pipeline.compute.pool import runner
    from pipeline.validation.validate import validate

    with runner(config.compute, config.data, renders=True) as workers:
        report = validate(config, workers)
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
    finished.of_validate(config).keep()
    print(f"{len(report)} checks found nothing off, see {file}")


if __name__ == "__main__":
    main(run, __doc__)
