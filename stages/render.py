"""Stage render: make the frames of every kept episode from the stored states. Resumes where it was stopped.

Where frames are rejected, it replays the reserves that take their place, as the stage replay does.
"""

from pipeline import gl
from pipeline.compute.pool import runner
from pipeline.config import Config
from pipeline.files import read_json
from pipeline.identity import refuse_unasked
from pipeline.planning import plan
from pipeline.run import dropped
from pipeline.run.outcome import outdated, rejections
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.run.stage import main
from pipeline.stores.frame_store import FrameStore, shown_of
from pipeline.stores.trajectory_store import TrajectoryStore


def run(config: Config) -> None:
    print(gl.choose())
    rows = plan.read(config.data / "plan.parquet")
    plan.refuse_other_settings(rows, config.replay)
    refuse_unasked(outdated(rows, config, gl.choose().device), config.data)
    dropped.refuse_unasked(rows, config)
    # The configuration may be another one since the plan was made.
    config.export.refuse_too_few(plan.demonstrations(rows))
    replayed = int(read_json(config.data / "replay.json")["replayed"])
    trajectories = TrajectoryStore(config.data / "trajectories")
    frames = FrameStore(config.data / "frames", config.render)
    with runner(config.compute, config.data, renders=True) as workers:
        rejected: dict[str, str] | None = None
        while (known := rejections(rows, shown_of(frames.rows()))) != rejected:
            rejected = known
            verdicts = Replays(config.demos, config.replay, trajectories.root, workers, config.filter).of(
                rows, rejected
            )
            rendered = render_plan(rows, config, trajectories.root, frames.root, workers)
            frames.keep(rendered)
    trajectories.keep(verdicts)
    if further := len(verdicts) - replayed:
        print(f"replayed {further} reserves, as frames before them were rejected")
    print(f"{len(rendered)} files of frames are in {frames.root}")


if __name__ == "__main__":
    main(run, __doc__)
