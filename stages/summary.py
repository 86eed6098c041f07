"""Stage summary: make contact sheets, of the run and of one task per suite, and print what the run made."""

from pipeline.run import counts, finished
from pipeline.run.run import PREVIEWS, SHEETS, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    rows, episodes = run.manifest, run.config.plan.episodes
    memory = finished.of_summary(run)
    if not memory.holds():
        _render(run)
        memory.keep()
    from rich.console import Console

    Console().print(counts.shown(rows, episodes))
    for sentence in counts.shortfalls(counts.targets(rows, episodes)):
        print(sentence)
    for sentence in counts.beyond_step_limit(rows):
        print(sentence)


def _render(run: Run) -> None:
    from pipeline.report import preview, sheets

    sheets.write(run.manifest, run.episodes(), run.path(SHEETS))
    previews = finished.of_previews(run)
    if not previews.holds():
        with run.workers(renders=True) as workers:
            preview.for_run(run.config, run.path(PREVIEWS), workers)
        previews.keep()


if __name__ == "__main__":
    main(run, __doc__)
