"""Stage replay: run the physics of every planned trajectory and judge it; needs no GL. Resumes where it was stopped."""

from pipeline.files import write_json
from pipeline.identity import refuse_unasked
from pipeline.planning import plan
from pipeline.run import dropped
from pipeline.run.outcome import outdated
from pipeline.run.replay_stage import Replays
from pipeline.run.run import REPLAY, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    rows, config = run.plan, run.config
    plan.refuse_other_settings(rows, config.replay)
    refuse_unasked(outdated(rows, run.trajectories, run.frames), run.folder)
    dropped.refuse_unasked(rows, run)
    with run.workers() as workers:
        replays = Replays(config.demos, config.replay, run.trajectories.root, workers, config.filter)
        verdicts = replays.of(rows)
    # Of the reserves, those too that the stage render replayed because frames were rejected.
    run.trajectories.keep(row.trajectory_id for row in rows)
    kept = sum(verdict.kept for verdict in verdicts.values())
    write_json(run.path(REPLAY), {"replayed": len(verdicts), "kept": kept})
    print(f"replayed {len(verdicts)} trajectories, {kept} are kept")


if __name__ == "__main__":
    main(run, __doc__)
