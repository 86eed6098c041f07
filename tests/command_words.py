"""Command lines, parsed without calling the command that they name."""

from collections.abc import Iterator, Sequence

import click

from pipeline.commands.command_line import top


def parse(words: Sequence[str]) -> click.Context:
    """Parse the words after the name of the program; return the context of the command, with its values.

    Raises:
        click.UsageError: when there is no such command, or it does not take the words.
    """
    command: click.Command | None = top
    name, left = "pipeline", list(words)
    while isinstance(command, click.Group):
        found, command, left = command.resolve_command(click.Context(command), left)
        name = f"{name} {found}"
    assert command is not None
    return command.make_context(name, left)


def commands(group: click.Group = top, *words: str) -> Iterator[tuple[str, ...]]:
    """Yield the words of each command of a group and of its groups."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from commands(command, *words, name)
        else:
            yield (*words, name)
