"""The kept episodes of a run as one of its datasets: what the stages ``export_*`` do."""

from __future__ import annotations

from typing import Any

from pipeline.config import Config
from pipeline.formats.base import Format
from pipeline.formats.episodes import Episodes
from pipeline.formats.export import export, is_current
from pipeline.run import outcome
from pipeline.run.compute import runner
from pipeline.run.episode_loader import EpisodeLoader


def export_run(target: Format[Any], config: Config) -> None:
    """Bring a run's dataset up to date, and say what was done."""
    episodes = kept_episodes(config)
    if is_current(target, episodes):
        print(f"{target.folder} has these {len(episodes.ids)} episodes already, see {target.record_file}")
        return
    with runner(config.compute, config.data) as workers:
        export(target, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {target.folder}")


def kept_episodes(config: Config) -> Episodes:
    """The kept episodes of a run, in the order they are written."""
    run = outcome.read(config)
    return Episodes(
        ids=run.kept,
        load=EpisodeLoader(config.data / "plan.parquet", config.data / "frames", config.render),
        suites={row.episode_id: row.suite for row in run.rows},
        content=run.contents(),
        demos={row.episode_id: row.demo_id for row in run.rows},
    )
