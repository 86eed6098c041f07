"""Stage inputs: write out the configuration, list the user's own files, and look whether stored ones have changed.

So DVC notices what it cannot see itself.
"""

from pipeline.config import Config
from pipeline.files import write_json
from pipeline.formats.registry import failures_of, formats_of
from pipeline.run import export, inputs
from pipeline.run.stage import main
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore


def run(config: Config) -> None:
    write_json(config.data / "settings.json", inputs.settings(config))
    write_json(config.data / "inputs.json", inputs.listing(config))
    TrajectoryStore(config.data / "trajectories").notice_changes()
    FrameStore(config.data / "frames", config.render).notice_changes()
    asked = (config.data, config.export, config.render.extras)
    for one in (*formats_of(*asked), *failures_of(*asked)):
        export.notice_changes(one)


if __name__ == "__main__":
    main(run, __doc__)
