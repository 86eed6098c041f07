"""Stage render: make the frames of every kept episode from the stored states. Resumes where it was stopped."""

from pipeline import gl
from pipeline.config import Config
from pipeline.rendering.render import render_plan
from pipeline.run import plan
from pipeline.run.compute import runner
from pipeline.run.frame_store import FrameStore
from pipeline.run.machine import same_machine
from pipeline.run.stage import main


def run(config: Config) -> None:
    print(gl.choose())
    same_machine(config.data, {"OpenGL device": gl.choose().device})
    rows = plan.read(config.data / "plan.parquet")
    folder = config.data / "frames"
    with runner(config.compute, config.data, gl.Shared) as workers:
        rendered = render_plan(rows, config, config.data / "trajectories", folder, workers)
    FrameStore(folder, config.render).keep(rendered)
    print(f"{len(rendered)} files of frames are in {folder}")


if __name__ == "__main__":
    main(run, __doc__)
