"""Stage card: the dataset card of each format, from the manifest and the reports."""

from pipeline.publish import card
from pipeline.run.run import CARD, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    card.write(run)
    print(f"{run.path(CARD)} has a README.md for each format; `python -m pipeline push` uploads it with the data")


if __name__ == "__main__":
    main(run, __doc__)
