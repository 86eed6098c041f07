"""Stage summary: draw contact sheets, of the run and of one task per suite, and print what the run made."""

from rich.console import Console

from pipeline import gl
from pipeline.compute.pool import runner
from pipeline.config import Config
from pipeline.publish import preview, sheets
from pipeline.run import manifest
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.stage import main


def run(config: Config) -> None:
    rows = manifest.read(config.data / "manifest.parquet")
    load = EpisodeLoader(config.data / "plan.parquet", config.data / "frames", config.render)
    drawn = sheets.draw(rows, load, config.data / "sheets")
    with runner(config.compute, config.data, gl.Shared) as workers:
        previews = preview.for_run(config, config.data / "previews", workers)
    console = Console()
    console.print(manifest.counts_table(rows))
    made = {
        "RLDS": config.data / "rlds",
        "LeRobot": config.data / "lerobot" / config.export.lerobot.name,
        "manifest": config.data / "manifest.parquet",
        **{f"{axis} sheet": path for axis, path in drawn.items()},
        **{f"{suite} previews": path for suite, path in previews.items()},
    }
    width = max(map(len, made))
    for name, path in made.items():
        console.print(f"{name:>{width}}  {path}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main(run, __doc__)
