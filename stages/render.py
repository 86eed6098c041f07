"""Stage render: make the frames of every kept episode from the stored states. Resumes where it was stopped.

Where frames are rejected, it replays the reserves that take their place, as the stage replay does.
"""

from pipeline import gl
from pipeline.files import read_json
from pipeline.identity import refuse_unasked
from pipeline.planning import plan
from pipeline.run import dropped
from pipeline.run.outcome import outdated, rejections
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.run.run import REPLAY, Run
from pipeline.run.stage import main
from pipeline.stores.frame_store import shown_of


def run(run: Run) -> None:
    print(gl.choose())
    rows, config = run.plan, run.config
    plan.refuse_other_settings(rows, config.replay)
    refuse_unasked(outdated(rows, run.trajectories, run.frames, gl.choose().device), run.folder)
    dropped.refuse_unasked(rows, run)
    # The configuration may be another one since the plan was made.
    config.export.refuse_too_few(plan.demonstrations(rows))
    replayed = int(read_json(run.path(REPLAY))["replayed"])
    with run.workers(renders=True) as workers:
        replays = Replays(config.demos, config.replay, run.trajectories.root, workers, config.filter)
        rejected: dict[str, str] | None = None
        while (known := rejections(rows, shown_of(run.frames.rows()))) != rejected:
            rejected = known
            verdicts = replays.of(rows, rejected)
            rendered = render_plan(rows, config, run.trajectories.root, run.frames.root, workers)
            run.frames.keep(rendered)
    run.trajectories.keep(verdicts)
    if further := len(verdicts) - replayed:
        print(f"replayed {further} reserves, as frames before them were rejected")
    print(f"{len(rendered)} files of frames are in {run.frames.root}")


if __name__ == "__main__":
    main(run, __doc__)
