"""Stage recipe: the fine-tuning recipe, and what each policy's code needs to train on the datasets as they are."""

from pipeline.clients.recipe import build, write
from pipeline.config import Config
from pipeline.run import manifest
from pipeline.run.stage import main


def run(config: Config) -> None:
    file, name = config.data / "manifest.parquet", config.export.lerobot.name
    recipe = build(file, manifest.read(file), name=config.export.rlds.name, lerobot=name)
    folder = config.data / "finetune"
    write(recipe, config.data / "lerobot" / name, folder)
    print(f"{folder / 'finetune.yaml'} has the recipe and a command line for each of {', '.join(recipe['clients'])}")


if __name__ == "__main__":
    main(run, __doc__)
