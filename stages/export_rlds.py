"""Stage export_rlds: write the kept episodes as RLDS, a set for each suite, without TensorFlow."""

import json

from pipeline.config import Config
from pipeline.files import keep_only
from pipeline.run import plan
from pipeline.run.compute import runner
from pipeline.run.episode_loader import EpisodeLoader, kept
from pipeline.run.stage import main
from pipeline.writers import rlds


def run(config: Config) -> None:
    plan_file = config.data / "plan.parquet"
    rows = plan.read(plan_file)
    ids = kept(rows, config.data, config.render)
    load = EpisodeLoader(plan_file, config.data / "frames", config.render)
    target = config.export.rlds
    sets = rlds.by_suite(ids, {row.episode_id: row.suite for row in rows}, target.name)
    out = config.data / "rlds"
    locations: dict[str, rlds.Location] = {}
    with runner(config.compute, config.data) as workers:
        for name, members in sets.items():
            shards = max(1, round(target.shards * len(members) / len(ids)))
            locations |= rlds.write(members, load, out, name=name, shards=shards, run=workers).locations
    keep_only(out, set(sets))
    (config.data / "rlds.json").write_text(json.dumps(locations, indent=0) + "\n")
    print(f"wrote {len(ids)} episodes to {', '.join(sets)} in {out}")


if __name__ == "__main__":
    main(run, __doc__)
