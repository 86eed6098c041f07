"""Stage recipe: the fine-tuning recipe, and what each policy's code needs to train on the datasets as they are."""

from pipeline.clients.recipe import build, write
from pipeline.config import Config
from pipeline.run import manifest
from pipeline.run.stage import main


def run(config: Config) -> None:
    file, folder = config.data / "manifest.parquet", config.data / "finetune"
    rlds, lerobot = config.export.rlds, config.export.lerobot
    names = {"name": rlds.name if rlds else None, "lerobot": lerobot.name if lerobot else None}
    recipe = build(file, manifest.read(file), **names)
    write(recipe, config.data / "lerobot" / lerobot.name if lerobot else None, folder)
    print(f"{folder / 'finetune.yaml'} has the recipe and a command line for each of {', '.join(recipe['clients'])}")


if __name__ == "__main__":
    main(run, __doc__)
