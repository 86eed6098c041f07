"""Stage card: the dataset card of each format, from the manifest and the reports."""

from pipeline.config import Config
from pipeline.formats.registry import formats_of
from pipeline.publish import card
from pipeline.run.stage import main


def run(config: Config) -> None:
    formats = formats_of(config.data, config.export, config.render.extras)
    card.write(config.data, formats, config.export.name, config.publish)
    print(f"{config.data / 'card'} has a README.md for each format; `python -m pipeline push` uploads it with the data")


if __name__ == "__main__":
    main(run, __doc__)
