"""Stage summary: draw a contact sheet for each axis and print what the run made."""

from rich.console import Console

from pipeline import manifest, sheets
from pipeline.config import Config
from pipeline.episodes import EpisodeLoader
from pipeline.stage import main


def run(config: Config) -> None:
    rows = manifest.read(config.data / "manifest.parquet")
    load = EpisodeLoader(config.data / "plan.parquet", config.data / "frames", config.render)
    drawn = sheets.draw(rows, load, config.data / "sheets")
    console = Console()
    console.print(manifest.counts_table(rows))
    for name, path in {
        "RLDS": config.data / "rlds" / config.export.rlds.name / "1.0.0",
        "LeRobot": config.data / "lerobot" / config.export.lerobot.name,
        "manifest": config.data / "manifest.parquet",
        **{f"{axis} sheet": path for axis, path in drawn.items()},
    }.items():
        console.print(f"{name:>16}  {path}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main(run, __doc__)
