"""Stage recipe: the fine-tuning recipe, and what each policy's code needs to train on the datasets as they are."""

from pipeline.clients.recipe import build, write
from pipeline.config import Config
from pipeline.run import manifest
from pipeline.run.stage import main


def run(config: Config) -> None:
    file = config.data / "manifest.parquet"
    recipe = build(file, manifest.read(file), config.export)
    write(recipe, config.data, config.export)
    made = config.data / "finetune" / "finetune.yaml"
    print(f"{made} has the recipe and a command line for each of {', '.join(recipe['clients'])}")


if __name__ == "__main__":
    main(run, __doc__)
