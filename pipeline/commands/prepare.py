"""Commands before a run: ``doctor``, ``axes``, ``tasks``, ``preview``, ``sources`` and ``rewrite``."""

import json
from collections.abc import Iterable
from pathlib import Path

import click

from pipeline.commands.base import (
    FILE_TO_WRITE,
    PATH,
    Command,
    ListCommand,
    OneOf,
    config_argument,
    example,
    load_config,
)

EVERY = "all"
"""Argument in place of an axis, for one picture of each axis."""

DEFAULTS = {"name": "preview", "plan": {"episodes": {}}}
"""Configuration of a preview without a file: the starter demonstrations and default ranges."""


@click.command(cls=Command, epilog=example("doctor configs/starter.yaml"))
@config_argument
def doctor(config: Path) -> int:
    """Check versions, OpenGL, folder, disk, memory and demonstrations for a run.

    Each check prints a line that begins with ok, warn or fail, and a remedy below it. No file of the run is
    written. If the plan is outdated, a new one is sampled, which may download textures or objects. The exit status is 1
    if a check fails.
    """
    from pipeline.run.run import Run
    from pipeline.validation import doctor

    return int(bool(doctor.run(Run(load_config(config)), config_file=config)))


@click.command(cls=ListCommand, epilog=example("axes"))
def axes() -> None:
    """List the axes of perturbation, with their components, regenerated parts of an episode and changed views."""
    from rich.console import Console
    from rich.table import Table

    from pipeline.axes import AXES, components_of
    from pipeline.episode_schema import ALL_VIEWS

    names_of_views = {frozenset(ALL_VIEWS): "all", frozenset({"image"}): "agent view", frozenset[str](): "none"}
    table = Table("axis", "components", "generated again", "changed views", box=None, pad_edge=False)
    for axis in AXES:
        kind = AXES[axis].kinds[0]
        components = ", ".join(components_of(axis))
        views = names_of_views.get(kind.views) or ", ".join(sorted(kind.views))
        table.add_row(axis, components, kind.layer.name.lower(), views)
    Console(highlight=False).print(table)
    print("Ranges and levels: see docs/configuration.md and docs/axes.md.")
    print("Pictures of an axis: see `python -m pipeline preview --help`.")


@click.command(cls=ListCommand, epilog=example("tasks 'libero_goal/*'"))
@click.argument(
    "patterns", metavar="[PATTERN]...", nargs=-1, help="Patterns as in demos.tasks, such as 'libero_goal/*'."
)
def tasks(patterns: tuple[str, ...]) -> None:
    """List LIBERO's tasks and your own tasks, by their names in demos.tasks, with their instructions.

    Each printed line has the name <suite>/<task>, a tab and the instruction.
    """
    from pipeline.libero.tasks import select_tasks

    for task in select_tasks(patterns or ["*"]):
        print(f"{task}\t{task.instruction}")


class AxisNames(OneOf):
    """Name of an axis, names of several joined by +, or ``all``."""

    def __init__(self) -> None:
        super().__init__(_axes)

    def convert(self, value: str, parameter: click.Parameter | None, context: click.Context | None) -> str:
        from pipeline.axes import axes_of

        if value == EVERY:
            return value
        try:
            return "+".join(axes_of(value))
        except ValueError as error:
            self.fail(f"{error}; or {EVERY}.", parameter, context)


def _axes() -> Iterable[str]:
    from pipeline.axes import AXES

    return (*AXES, EVERY)


@click.command(
    cls=Command,
    epilog=example("preview 'libero_goal/turn_on*' camera", "preview 'libero_10/KITCHEN*' all --out kitchen.jpg"),
)
@click.argument("task", metavar="TASK", help="Pattern of <suite>/<task>, such as 'libero_goal/turn_on*'.")
@click.argument(
    "axis",
    metavar="AXIS",
    type=AxisNames(),
    help=f"An axis, several joined by +, or `{EVERY}` for one picture of each axis.",
)
@click.argument(
    "config",
    metavar="[CONFIG]",
    required=False,
    type=PATH,
    help="Configuration whose seed, ranges and demonstrations are used (default: the starter set and default ranges).",
)
@click.option(
    "--out",
    metavar="FILE",
    type=FILE_TO_WRITE,
    default=Path("sheet.png"),
    help="Picture to write (default: sheet.png).",
)
def preview(task: str, axis: str, config: Path | None, out: Path) -> None:
    """Render perturbations of a task into one picture.

    The picture shows the first frame of the task, and up to eleven perturbations over the components and levels of an
    axis. Several axes joined by +, such as camera+noise, change each frame together. With `all`, the picture shows a
    perturbation of a middle level on each axis next to the clean twin.

    The picture is written to sheet.png or to the file of --out: a JPEG if its name ends in .jpg, else a PNG. An
    existing file is overwritten only if it is a picture that a command wrote. An axis that the configuration does not
    name has default ranges.
    """
    from pipeline import gl
    from pipeline.config import Config
    from pipeline.libero.tasks import select_tasks
    from pipeline.outputs import reject_other_file, written
    from pipeline.report import preview
    from pipeline.testset import benchmark

    settings = load_config(config) if config else Config.model_validate(DEFAULTS)
    chosen = select_tasks([task])
    reject_other_file(out)
    gl.choose()  # Without a working renderer, stop before slow work.
    stage = preview.staged(chosen, settings)
    with written(out) as temporary:
        if axis == EVERY:
            picture = preview.overview(stage, settings, benchmark.load())
        else:
            picture = preview.axis_sheet(stage, axis, settings, benchmark.load())
        if out.suffix == ".jpg":
            picture.save(temporary, format="JPEG", quality=90)
        else:
            picture.save(temporary, format="PNG")
        among = f", the first of {len(chosen)} tasks" if len(chosen) > 1 else ""
        print(f"wrote {out}, which shows {axis} on {stage.demo.demo_id}{among}")


@click.command(cls=Command, epilog=example("sources configs/starter.yaml"))
@config_argument
def sources(config: Path) -> None:
    """Fetch and convert the textures and objects of a configuration, and count them.

    Downloads and converted files are written below data/textures and data/objects, which all runs share. An axis that
    is not configured counts with its default sources. The last line of the output is JSON.
    """
    from pipeline.axes import AXES

    axes_of_run = load_config(config).plan.axes.configured()
    numbers: dict[str, int] = {}
    for name, axis in AXES.items():
        numbers.update((axes_of_run.get(name) or axis()).offered())
    print(json.dumps(numbers))


@click.command(
    cls=Command,
    epilog=example(
        "rewrite tasks/my_suite/my_task.bddl --out bank.yaml --endpoint http://localhost:8000/v1 --model my-model"
    ),
)
@click.argument("bddl_file", metavar="BDDL_FILE", type=PATH, help="File of the task, <suite>/<task>.bddl.")
@click.option(
    "--out", metavar="FILE", type=FILE_TO_WRITE, required=True, help="Bank to extend or create, such as bank.yaml."
)
@click.option(
    "--per-class",
    metavar="N",
    type=click.IntRange(min=1),
    default=9,
    help="Number of rewrites of each class in the finished bank (default: 9).",
)
@click.option(
    "--endpoint",
    metavar="URL",
    required=True,
    help="Address of the endpoint before /chat/completions, such as http://localhost:8000/v1.",
)
@click.option("--model", metavar="NAME", required=True, help="Name of the model at the endpoint.")
def rewrite(bddl_file: Path, out: Path, per_class: int, endpoint: str, model: str) -> None:
    """Add rewrites of a task's instruction to a bank, generated by a language model.

    The bank is the YAML file of --out, which plan.axes.language.bank of a configuration then names. An
    OpenAI-compatible endpoint generates rewrites of each class (distraction, common sense, reasoning chain,
    paraphrase) until the bank has enough of each class. A rewrite must pass the same checks as the shipped bank. The
    bank is written again with each accepted rewrite, and may have comments only at its beginning. A stopped command
    resumes when it is called again. The key of the endpoint is read from OPENAI_API_KEY.
    """
    from pipeline.rewriting.language_model import LanguageModel
    from pipeline.rewriting.rewrite import extend

    extend(bddl_file, out, per_class, LanguageModel(endpoint, model))
    print(f"{out} contains {per_class} rewrites of each class for {bddl_file.stem}")
