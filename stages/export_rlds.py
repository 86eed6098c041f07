"""Stage export_rlds: write the kept episodes as RLDS, through TFDS and without TensorFlow."""

import json

from pipeline import plan
from pipeline.compute import runner
from pipeline.config import Config
from pipeline.episodes import EpisodeLoader, kept
from pipeline.stage import main
from pipeline.writers import rlds


def run(config: Config) -> None:
    plan_file = config.data / "plan.parquet"
    ids = kept(plan.read(plan_file), config.data, config.render)
    load = EpisodeLoader(plan_file, config.data / "frames", config.render)
    target = config.export.rlds
    with runner(config.compute) as workers:
        report = rlds.write(ids, load, config.data / "rlds", name=target.name, shards=target.shards, run=workers)
    (config.data / "rlds.json").write_text(json.dumps(report.locations, indent=0) + "\n")
    print(f"wrote {len(ids)} episodes to {config.data / 'rlds'}")


if __name__ == "__main__":
    main(run, __doc__)
