"""Stage export_lerobot: write the kept episodes as a LeRobot v3.0 dataset, through lerobot itself."""

import json

from pipeline.config import Config
from pipeline.run import plan
from pipeline.run.compute import runner
from pipeline.run.episode_loader import EpisodeLoader, kept
from pipeline.run.stage import main
from pipeline.writers import lerobot


def run(config: Config) -> None:
    plan_file = config.data / "plan.parquet"
    ids = kept(plan.read(plan_file), config.data, config.render)
    load = EpisodeLoader(plan_file, config.data / "frames", config.render)
    target = config.export.lerobot
    out = config.data / "lerobot" / target.name
    with runner(config.compute, config.data) as workers:
        report = lerobot.write(
            ids, load, out, repo_id=target.name, parts=target.parts, run=workers, frames=target.frames
        )
    (config.data / "lerobot.json").write_text(json.dumps(report.episode_index, indent=0) + "\n")
    print(f"wrote {len(ids)} episodes to {out}")


if __name__ == "__main__":
    main(run, __doc__)
