"""Stage inputs: list the user's own files that the configuration names, so that a changed one is noticed."""

from pipeline.config import Config
from pipeline.run import inputs
from pipeline.run.stage import main


def run(config: Config) -> None:
    inputs.write(inputs.listing(config), config.data / "inputs.json")


if __name__ == "__main__":
    main(run, __doc__)
