"""Registration of commands, and the choice of a run: by its configuration, or else by ``params.yaml``."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from pipeline.config import Config
    from pipeline.run.run import Run

PARAMS = Path("params.yaml")

Fill = Callable[[argparse.ArgumentParser], object]


class LazyParser(argparse.ArgumentParser):
    """Parser that adds its arguments at the first parse, as the imports for their choices can take long.

    Options may stand between arguments. Plain argparse treats an optional argument, such as CONFIG, as left out if an
    option comes before it.
    """

    summary: str = ""
    fills: tuple[Fill, ...] = ()
    _sorting = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        fills, self.fills = self.fills, ()
        for fill in fills:
            fill(self)
        if self._subparsers or self._sorting:
            return super().parse_known_args(args, namespace)
        self._sorting = True  # The next call calls this method again.
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._sorting = False


def argument(*names: str, **how: Any) -> Fill:
    """Return a function that adds an argument to a command; the parameters are those of ``add_argument``."""
    return lambda command: command.add_argument(*names, **how)


def value(name: str, metavar: str, told: str, kind: Callable[[str], object] = Path, **how: Any) -> Fill:
    """Return a function that adds an argument with a value, by default a path; ``told`` is its help."""
    return argument(name, metavar=metavar, help=told, type=kind, **how)


def add(commands: Any, run: Callable[[argparse.Namespace], int | None], *fills: Fill) -> None:
    """Add a command with the name of a function, whose docstring becomes the help text.

    Args:
        run: performs the command; returns the exit status, or `None` for 0.
        fills: add the command's arguments once they are needed.
    """
    described, _, details = (inspect.getdoc(run) or "").partition("\n\n")
    description = f"{described[:1].upper()}{described[1:]}.\n\n{details}".strip()
    formatter = argparse.RawDescriptionHelpFormatter
    command = commands.add_parser(run.__name__, help=described, description=description, formatter_class=formatter)
    command.set_defaults(run=run)
    command.summary, command.fills = described, fills


def add_group(commands: Any, name: str, summary: str) -> Any:
    """Add a command that has subcommands, and return the object that ``add`` adds them to."""
    group = commands.add_parser(name, help=summary, description=f"{summary[:1].upper()}{summary[1:]}.")
    group.summary = summary
    return group.add_subparsers(required=True, metavar="VERB")


def positive(text: str) -> int:
    """Parse an argument that is a whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is less than 1")
    return number


def at_least_zero(text: str) -> int:
    """Parse an argument that is a whole number of at least 0."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{number} is less than 0")
    return number


def _positive_number(text: str) -> float:
    number = float(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{number} is not above 0")
    return number


def add_fields(command: argparse.ArgumentParser, model: type[BaseModel], **options: str) -> None:
    """Add an option for each named field of a model, with the field's type, choices and docstring.

    An option that the user leaves out sets no attribute, so that the model's default holds.

    Args:
        options: field to option.
    """
    for name, option in options.items():
        field = model.model_fields[name]
        kind, default = field.annotation, field.default
        how: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS}
        if isinstance(default, tuple):
            how["nargs"], default = "+", " ".join(default)
        if get_origin(kind) is Literal:
            how["choices"] = get_args(kind)
        else:
            kind = next(iter(get_args(kind)), kind)
            above_0 = positive if kind is int else _positive_number
            how |= {"type": above_0 if field.metadata else kind, "metavar": option.strip("-").upper()}
        suffix = f" (default: {default})" if default not in (None, "", ()) else ""
        help_text = f"{field.description}{suffix}".replace("\n", " ").replace("``", "")
        command.add_argument(option, help=help_text, **how)


_CONFIG = "file of the run's configuration, such as configs/starter.yaml (default: the one that params.yaml names)"
add_config = value("config", "CONFIG", _CONFIG, nargs="?")
"""Argument for the run's configuration, the last argument of a command."""


def config_file(arguments: argparse.Namespace) -> Path:
    """Return the path of the given configuration, or of the configuration that ``dvc repro`` would run here.

    Raises:
        PipelineError: when no configuration is given, and ``params.yaml`` names none.
    """
    if arguments.config is not None:
        return Path(arguments.config)
    import yaml

    try:
        return Path("configs") / f"{yaml.safe_load(PARAMS.read_text())['run']}.yaml"
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        raise PipelineError(
            f"no configuration was named, and there is none to take instead ({error})",
            where=PARAMS,
            remedy="name one, such as configs/starter.yaml, or call this in the folder of the project",
        ) from error


def loaded(arguments: argparse.Namespace) -> Config:
    """Load the configuration that a command was given, even if its run's folder belongs to another file.

    Raises:
        PipelineError: as ``config.load``.
    """
    from pipeline.config import load

    return load(config_file(arguments))


def owned(arguments: argparse.Namespace) -> Run:
    """Open the run that a command reads.

    Raises:
        PipelineError: as ``run.claim.owned``.
    """
    from pipeline.run import claim

    return claim.owned(config_file(arguments))


def plan_of(text: str) -> Path:
    """Parse an argument that names a configuration, and return the file of its run's plan."""
    from pipeline.run import claim

    return claim.owned(Path(text)).plan_file
