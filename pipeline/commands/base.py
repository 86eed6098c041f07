"""Parts of the command line on top of click: lazy groups, commands, and shared parameters.

Click was chosen over cyclopts and tyro: ``--help`` of a single command took 0.1 s with click, and 0.3 s and 0.5 s with
the others. Click is installed with Dask anyway.
"""

from __future__ import annotations

import importlib
import os
import select
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args, get_origin

import click
from click.shell_completion import CompletionItem

from pipeline.errors import PipelineError
from pipeline.exit_status import GO_ON

if TYPE_CHECKING:
    from pydantic import BaseModel

    from pipeline.config import Config
    from pipeline.run.run import Run


class Command(click.Command):
    """Command whose function returns an exit status, or `None` for 0.

    Raises:
        PipelineError: when the reader of the output ends while the command works, as its work is then unfinished.
    """

    only_lists = False
    """True if the command only prints a list, of which a reader such as `head` may have enough."""

    def invoke(self, context: click.Context) -> int:
        try:
            status = super().invoke(context)
        except BrokenPipeError as error:
            if not _has_lost_its_reader(sys.stdout.fileno()):  # Click would end without a message.
                raise PipelineError("the connection to another process broke", remedy=GO_ON) from error
            _discard_output()
            if self.only_lists:
                return 0
            raise PipelineError("the command stopped, as nothing reads its output any more", remedy=GO_ON) from error
        try:
            sys.stdout.flush()  # While a closed pipe can still be handled, unlike when Python ends.
        except BrokenPipeError:  # The work is finished.
            _discard_output()
        return int(status or 0)


class ListCommand(Command):
    """Command that only prints a list."""

    only_lists = True


def _discard_output() -> None:
    """Send the rest of the output nowhere: Python writes it when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _has_lost_its_reader(descriptor: int) -> bool:
    """Return whether ``descriptor`` is a pipe or a socket whose other end is closed."""
    poll = select.poll()
    poll.register(descriptor, 0)
    return any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0))


class Listed(NamedTuple):
    """Place of a command, and its line in the help of its group.

    Attributes:
        module: module of ``pipeline.commands``; it has the command under its name, with _ in place of -.
    """

    module: str
    summary: str


class LazyGroup(click.Group):
    """Group whose commands are imported when they are called, so that its help is shown at once.

    Attributes:
        sections: heading to the commands that the help lists under it, by their names.
        moved: former name of a command to its present one.
    """

    def __init__(
        self, name: str, *, sections: Mapping[str, Mapping[str, Listed]], moved: Mapping[str, str] = {}, **options: Any
    ) -> None:
        super().__init__(name, **options)
        self.sections, self.moved = sections, moved

    def list_commands(self, context: click.Context) -> list[str]:
        names: list[str] = []
        for commands in self.sections.values():
            names += commands
        return names

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        for commands in self.sections.values():
            if name in commands:
                module = importlib.import_module(f"pipeline.commands.{commands[name].module}")
                command: click.Command = getattr(module, name.replace("-", "_"))
                return command
        if context.resilient_parsing:  # A shell completes words: errors would be printed in the middle of its line.
            return None
        if name in self.moved:
            raise click.UsageError(f"the command `{name}` is now `{self.moved[name]}`", context)
        similar = get_close_matches(name, self.list_commands(context), n=1)
        if similar:
            raise click.UsageError(f"there is no command `{name}`; did you mean `{similar[0]}`?", context)
        return None

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        for heading, commands in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name, listed.summary) for name, listed in commands.items()])


class OneOf(click.ParamType[str]):
    """Name of a registry, which is imported when a value is checked."""

    name = "name"

    def __init__(self, load_names: Callable[[], Iterable[str]]) -> None:
        self._load_names = load_names

    def names(self) -> list[str]:
        """List the names of the registry."""
        return list(self._load_names())

    def convert(self, value: str, parameter: click.Parameter | None, context: click.Context | None) -> str:
        names = self.names()
        if value not in names:
            similar = get_close_matches(value, names, n=1)
            question = f" Did you mean {similar[0]}?" if similar else ""
            self.fail(f"{value!r} is not one of {', '.join(names)}.{question}", parameter, context)
        return value

    def shell_complete(
        self, context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]


class NamesOption(click.Option):
    """Option of the type ``OneOf``, whose help ends with the names; they are loaded when the help is shown."""

    def get_help_record(self, context: click.Context) -> tuple[str, str] | None:
        record = super().get_help_record(context)
        if record is None or not isinstance(self.type, OneOf):
            return record
        option, help_text = record
        return option, f"{help_text} {', '.join(self.type.names())}."


PROGRAM = "python -m pipeline"
"""Program in the examples of help pages."""

EXAMPLE_WIDTH = 72
"""Largest number of characters in a line of an example, which fits into 80 columns with its indent."""


def example(*commands: str) -> str:
    """Return the last lines of a help page, for ``epilog``: example commands, given without the program."""
    text = "\b\n"  # Keeps click from joining the lines.
    text += "Examples:" if len(commands) > 1 else "Example:"
    for command in commands:
        parts = wrap(f"{PROGRAM} {command}", EXAMPLE_WIDTH, break_long_words=False, break_on_hyphens=False)
        text += "\n  " + " \\\n      ".join(parts)
    return text


PATH = click.Path(path_type=Path)


class _FileToWrite(click.Path):
    """Path of a file to write, which may not exist yet. A path that ends with a slash names a folder."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        if str(value).endswith(os.sep):
            self.fail(f"{value!r} names a folder; add the name of the file to write", parameter, context)
        return super().convert(value, parameter, context)


FILE_TO_WRITE = _FileToWrite(path_type=Path)

result_paths_argument = click.argument(
    "results",
    metavar="PATH...",
    nargs=-1,
    required=True,
    type=PATH,
    help="Folders of `evaluate`; folders or files of vla-eval (*_aggregate.json) and lerobot-eval (eval_info.json).",
)

config_argument = click.argument(
    "config", metavar="CONFIG", type=PATH, help="File of the run's configuration, such as configs/starter.yaml."
)


def model_options(model: type[BaseModel], **options: str) -> Callable[[Any], Any]:
    """Return a decorator that adds an option for each named field of a model.

    Type, choices and help text are those of the field. An option that the user leaves out is `None` or an empty tuple.

    Args:
        options: field to option.
    """
    decorators = [_field_option(model, name, option) for name, option in options.items()]

    def decorate(function: Any) -> Any:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


_BOUNDS = {"ge": ("min", False), "gt": ("min", True), "le": ("max", False), "lt": ("max", True)}
"""Attribute of a field's limit to the end of the range, and whether the range excludes it."""


def _bounds(limits: Sequence[Any]) -> dict[str, Any]:
    """Return the limits of a field as arguments of click's ranges."""
    bounds: dict[str, Any] = {}
    for limit in limits:
        for name, (end, is_open) in _BOUNDS.items():
            if hasattr(limit, name):
                bounds |= {end: getattr(limit, name), f"{end}_open": is_open}
    return bounds


def _field_option(model: type[BaseModel], name: str, option: str) -> Callable[[Any], Any]:
    field = model.model_fields[name]
    kind, default = field.annotation, field.default
    several = isinstance(default, tuple)
    kind_of_value = kind if get_origin(kind) is Literal else next(iter(get_args(kind)), kind)
    if get_origin(kind_of_value) is Annotated:
        kind_of_value = get_args(kind_of_value)[0]
    parameter_type: Any = kind_of_value
    if get_origin(kind_of_value) is Literal:
        parameter_type = click.Choice(get_args(kind_of_value))
    elif kind_of_value is Path:
        parameter_type = PATH
    elif field.metadata and kind_of_value is int:
        parameter_type = click.IntRange(**_bounds(field.metadata))
    elif field.metadata and kind_of_value is float:
        parameter_type = click.FloatRange(**_bounds(field.metadata))
    help_text = str(field.description).replace("\n", " ").replace("``", "")
    help_text = help_text[:1].upper() + help_text[1:]
    if default not in (None, "", ()):
        help_text += f" (default: {' '.join(default) if several else default})"
    if several:
        help_text += "; may be given several times"
    metavars: dict[Any, str] = {Path: "FILE", int: "N", float: "N"}
    metavar = None if isinstance(parameter_type, click.Choice) else metavars.get(kind_of_value, "TEXT")
    return click.option(option, name, type=parameter_type, multiple=several, metavar=metavar, help=help_text)


def given(values: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Select the values of a model's fields that the user gave."""
    return {name: value for name, value in values.items() if name in model.model_fields and value not in (None, ())}


def load_config(file: Path) -> Config:
    """Load a configuration, even if the folder of its run belongs to another file.

    Raises:
        PipelineError: as ``config.load``.
    """
    from pipeline.config import load

    return load(file)


def open_run(config: Path) -> Run:
    """Open the run of a configuration.

    Raises:
        PipelineError: as ``run.claim.open_run``.
    """
    from pipeline.run import claim

    return claim.open_run(config)
