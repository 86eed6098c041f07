"""Stage manifest: one row for every planned episode, the statistics for OpenVLA-OFT, and the counts."""

import json

from pipeline.config import Config
from pipeline.formats import registry
from pipeline.formats.rlds_layout import by_suite
from pipeline.run import manifest, motion_statistics, plan
from pipeline.run.episode_loader import EpisodeLoader, kept, outcome, verdicts
from pipeline.run.stage import main
from pipeline.run.stores import FrameStore, TrajectoryStore


def run(config: Config) -> None:
    data = config.data
    plan_file, trajectories = data / "plan.parquet", data / "trajectories"
    rows = plan.read(plan_file)
    known = verdicts(rows, trajectories)
    became = outcome(rows, data, config.render)
    store, frames = TrajectoryStore(trajectories), FrameStore(data / "frames", config.render)
    rendered = {row.trajectory_id for row in rows if became[row.episode_id].kept}
    table = manifest.build(
        rows,
        outcome=became,
        replayed={trajectory_id: store.outcome(trajectory_id) for trajectory_id in known},
        devices={trajectory_id: frames.device(trajectory_id) for trajectory_id in rendered},
        places=registry.places(registry.formats_of(data, config.export)),
        columns=registry.columns(),
    )
    manifest.write(table, data / "manifest.parquet", manifest.Settings.of(config))

    load = EpisodeLoader(plan_file, data / "frames", config.render)
    ids = kept(rows, data, config.render)
    sets = by_suite(ids, {row.episode_id: row.suite for row in rows}, config.export.rlds.name)
    figures = {
        name: motion_statistics.openvla([load.motion(episode) for episode in members]) for name, members in sets.items()
    }
    (data / "dataset_statistics.json").write_text(json.dumps(figures, indent=1) + "\n")
    (data / "counts.json").write_text(json.dumps(manifest.counts(table.to_pylist()), indent=1) + "\n")


if __name__ == "__main__":
    main(run, __doc__)
