"""Stage replay: run the physics of every planned trajectory and judge it; needs no GL. Resumes where it was stopped."""

from pipeline.compute.pool import runner
from pipeline.config import Config
from pipeline.files import write_json
from pipeline.identity import refuse_unasked
from pipeline.planning import plan
from pipeline.run import dropped
from pipeline.run.outcome import outdated
from pipeline.run.replay_stage import Replays
from pipeline.run.stage import main
from pipeline.stores.trajectory_store import TrajectoryStore


def run(config: Config) -> None:
    rows = plan.read(config.data / "plan.parquet")
    plan.refuse_other_settings(rows, config.replay)
    refuse_unasked(outdated(rows, config), config.data)
    dropped.refuse_unasked(rows, config)
    folder = config.data / "trajectories"
    with runner(config.compute, config.data) as workers:
        verdicts = Replays(config.demos, config.replay, folder, workers, config.filter).of(rows)
    # Of the reserves, those too that the stage render replayed because frames were rejected.
    TrajectoryStore(folder).keep(row.trajectory_id for row in rows)
    kept = sum(verdict.kept for verdict in verdicts.values())
    write_json(config.data / "replay.json", {"replayed": len(verdicts), "kept": kept})
    print(f"replayed {len(verdicts)} trajectories, {kept} are kept")


if __name__ == "__main__":
    main(run, __doc__)
