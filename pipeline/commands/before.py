"""Commands before a run: ``doctor``, ``axes``, ``tasks``, ``preview``, ``sources`` and ``rewrite``."""

import argparse
import json
from pathlib import Path
from typing import Any

from pipeline.commands.base import add, add_config, loaded, positive, value

TITLE = "before a run"

PREVIEW = "perturbed-demos: preview"
"""Comment in the pictures of `preview`, which marks files that it may overwrite."""

EVERY = "all"
"""Argument in place of an axis, for one picture of each axis."""


def add_commands(commands: Any) -> None:
    add(commands, doctor, add_config)
    add(commands, axes)
    add(commands, tasks, value("patterns", "PATTERN", "as in demos.tasks, such as 'libero_goal/*'", str, nargs="*"))
    out = value("--out", "FILE", "picture to write (default: sheet.png)", default=Path("sheet.png"))
    add(commands, preview, _preview_arguments, add_config, out)
    add(commands, sources, add_config)
    add(
        commands,
        rewrite,
        value("bddl_file", "BDDL_FILE", "the task, <suite>/<task>.bddl"),
        value("--out", "OUT", "bank to extend or to begin, such as bank.yaml", required=True),
        value("--per-class", "N", "rewrites of each class wanted (default: 9)", positive, default=9),
        value("--endpoint", "URL", "before /chat/completions: http://localhost:8000/v1", str, required=True),
        value("--model", "NAME", "name of the model at the endpoint", str, required=True),
    )


def doctor(arguments: argparse.Namespace) -> int:
    """check versions, OpenGL, disk, memory and demonstrations for a configuration; changes nothing"""
    from pipeline.run.run import Run
    from pipeline.validation import doctor

    return doctor.run(Run(loaded(arguments)))


def axes(arguments: argparse.Namespace) -> None:
    """list the axes of perturbation, their components and what of an episode each makes anew"""
    from rich.console import Console
    from rich.table import Table

    from pipeline.axes import AXES, components_of

    table = Table("axis", "components", "made again", "changes", box=None)
    for axis in AXES:
        kind = AXES[axis].draws[0]
        views = " and ".join(sorted(kind.views)) or "instruction"
        table.add_row(axis, ", ".join(components_of(axis)), kind.layer.name.lower(), views)
    Console(highlight=False).print(table)
    print("Ranges and levels: docs/configuration.md and docs/axes.md. `preview TASK AXIS` shows what an axis does.")


def tasks(arguments: argparse.Namespace) -> None:
    """list LIBERO's tasks and your own, as demos.tasks names them, with their instructions"""
    from pipeline.libero.tasks import select_tasks

    for task in select_tasks(arguments.patterns or ["*"]):
        print(f"{task}\t{task.instruction}")


def _preview_arguments(command: argparse.ArgumentParser) -> None:
    from pipeline.axes import AXES

    axes = ", ".join((*AXES, EVERY))
    command.add_argument("task", metavar="TASK", help="a pattern of <suite>/<task>, such as 'libero_goal/turn_on*'")
    command.add_argument("axis", type=_axis, metavar="AXIS", help=f"any of {axes}, or several joined by +")


def _axis(name: str) -> str:
    """Return the name of an axis, of several joined by + in their order, or ``all``.

    Raises:
        ArgumentTypeError: when it names no axis.
    """
    from pipeline.axes import axes_of

    if name == EVERY:
        return name
    try:
        return "+".join(axes_of(name))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}; or {EVERY}") from error


def preview(arguments: argparse.Namespace) -> None:
    """render what an axis does to a task: its first frame, and up to eleven perturbations over components and levels

    Several axes joined by +, such as `camera+noise`, change each picture together, as episodes of a plan do.

    With `all`, one strong perturbation on each axis beside the clean twin. A name that ends in .jpg gives JPEG, else
    PNG. Only a picture of an earlier preview is overwritten. Seed, ranges and demonstrations are those of the
    configuration. An axis that it does not name has default ranges.
    """
    from PIL.PngImagePlugin import PngInfo

    from pipeline import gl
    from pipeline.files import refuse_other_file, replaced
    from pipeline.libero.tasks import select_tasks
    from pipeline.report import preview
    from pipeline.testset import benchmark

    config = loaded(arguments)
    chosen = select_tasks([arguments.task])
    refuse_other_file(arguments.out, PREVIEW)
    gl.choose()  # Without a working renderer, stop before slow work.
    stage = preview.staged(chosen, config)
    with replaced(arguments.out) as temporary:
        if arguments.axis == EVERY:
            picture = preview.overview(stage, config, benchmark.load())
        else:
            picture = preview.axis_sheet(stage, arguments.axis, config, benchmark.load())
        if arguments.out.suffix == ".jpg":
            picture.save(temporary, format="JPEG", quality=90, comment=PREVIEW)
        else:
            metadata = PngInfo()
            metadata.add_text("Software", PREVIEW)
            picture.save(temporary, format="PNG", pnginfo=metadata)
        among = f", the first of {len(chosen)} tasks" if len(chosen) > 1 else ""
        print(f"{arguments.out} shows {arguments.axis} on {stage.demo.demo_id}{among}")


def sources(arguments: argparse.Namespace) -> None:
    """fetch and convert the textures and objects that a configuration names, as its plan would, and count them

    An axis that is not configured counts with its default sources.
    """
    from pipeline.axes import AXES

    axes_of_run = loaded(arguments).plan.axes.configured()
    numbers: dict[str, int] = {}
    for name, axis in AXES.items():
        numbers.update((axes_of_run.get(name) or axis()).offered())
    print(json.dumps(numbers))


def rewrite(arguments: argparse.Namespace) -> None:
    """have a language model reword a task's instruction, lint what it says, and add it to a bank of rewrites

    Asks an OpenAI-compatible endpoint for rewrites of each class (distraction, common sense, reasoning chain,
    paraphrase) until the bank has enough of each. The same lint as of the shipped bank decides what is let in. Run
    again, it goes on where it was stopped. A key is read from OPENAI_API_KEY.
    """
    from pipeline.rewriting.language_model import LanguageModel
    from pipeline.rewriting.rewrite import extend

    extend(arguments.bddl_file, arguments.out, arguments.per_class, LanguageModel(arguments.endpoint, arguments.model))
    print(f"{arguments.out} holds {arguments.per_class} rewrites of each class for {arguments.bddl_file.stem}")
