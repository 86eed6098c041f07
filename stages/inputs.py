"""Stage inputs: write out the configuration, list the user's own files, and look whether stored ones have changed.

So DVC notices what it cannot see itself.
"""

from pipeline.config import Config
from pipeline.formats.registry import formats_of
from pipeline.run import export, inputs
from pipeline.run.stage import main
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore


def run(config: Config) -> None:
    inputs.write(inputs.settings(config), config.data / "settings.json")
    inputs.write(inputs.listing(config), config.data / "inputs.json")
    TrajectoryStore(config.data / "trajectories").settle()
    FrameStore(config.data / "frames", config.render).settle()
    for one in formats_of(config.data, config.export, config.render.extras):
        export.settle(one)


if __name__ == "__main__":
    main(run, __doc__)
