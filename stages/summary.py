"""Stage summary: make contact sheets, of the run and of one task per suite, and print what the run made."""

from collections.abc import Sequence
from typing import Any

from pipeline.config import Config
from pipeline.run import counts, finished, manifest
from pipeline.run.stage import main


def run(config: Config) -> None:
    rows = manifest.read(config.data / "manifest.parquet")
    memory = finished.of_summary(config)
    if not memory.holds():
        _draw(rows, config)
        memory.keep()
    from rich.console import Console

    Console().print(counts.shown(rows, config.plan.episodes))
    for sentence in counts.shortfalls(counts.targets(rows, config.plan.episodes)):
        print(sentence)
    for sentence in counts.beyond_step_limit(rows):
        print(sentence)


def _draw(rows: Sequence[dict[str, Any]], config: Config) -> None:
    from pipeline.compute.pool import runner
    from pipeline.report import preview, sheets
    from pipeline.run.episode_loader import EpisodeLoader

    load = EpisodeLoader(config.data, config.render)
    sheets.write(rows, load, config.data / "sheets")
    previews = finished.of_previews(config)
    if not previews.holds():
        with runner(config.compute, config.data, renders=True) as workers:
            preview.for_run(config, config.data / "previews", workers)
        previews.keep()


if __name__ == "__main__":
    main(run, __doc__)
