"""Stage recipe: the fine-tuning recipe, and what each policy's code needs to train on the datasets as they are."""

from pipeline.clients.recipe import RECIPE, build, write
from pipeline.run.run import FINETUNE, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    export = run.config.export
    recipe = build(run.manifest_file, run.manifest, export)
    write(recipe, run.path(FINETUNE), export, {dataset.name: dataset.folder for dataset in run.formats})
    print(f"{run.path(FINETUNE) / RECIPE} has the recipe and a command line for each of {', '.join(recipe['clients'])}")


if __name__ == "__main__":
    main(run, __doc__)
