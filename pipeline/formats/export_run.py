"""The kept episodes of a run as one of its datasets: what the stages ``export_*`` do."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from pipeline.config import Config
from pipeline.formats.base import Episodes, Format
from pipeline.formats.export import export, is_current
from pipeline.run import plan
from pipeline.run.compute import runner
from pipeline.run.episode_loader import EpisodeLoader, kept
from pipeline.run.stores import FrameStore
from pipeline.seeding import digest
from pipeline.versions import fingerprint


def export_run(target: Format[Any], config: Config) -> None:
    """Bring a run's dataset up to date, and say what was done."""
    episodes = kept_episodes(config)
    if is_current(target, episodes):
        print(f"{target.folder} has these {len(episodes.ids)} episodes already, see {target.record_file}")
        return
    with runner(config.compute) as workers:
        export(target, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {target.folder}")


def kept_episodes(config: Config) -> Episodes:
    """The kept episodes of a run, in the order they are written."""
    plan_file = config.data / "plan.parquet"
    rows = {row.episode_id: row for row in plan.read(plan_file)}
    ids = kept(list(rows.values()), config.data, config.render)
    frames = FrameStore(config.data / "frames", config.render)
    made_by = {
        trajectory: (
            fingerprint(),
            config.render.model_dump(mode="json"),
            frames.device(trajectory),
            frames.load(trajectory, []).replay_mode,
        )
        for trajectory in {rows[episode].trajectory_id for episode in ids}
    }
    return Episodes(
        ids=ids,
        load=EpisodeLoader(plan_file, config.data / "frames", config.render),
        suites={episode: rows[episode].suite for episode in ids},
        # The row has the streams of frames, the instruction and the provenance.
        content={episode: digest(asdict(rows[episode]), *made_by[rows[episode].trajectory_id])[:16] for episode in ids},
    )
