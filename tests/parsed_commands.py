"""Commands of the parser of `diffuscope`, those of its groups included."""

from collections.abc import Iterator
from typing import Any

import typer

from services.cli import app


def parsed_commands() -> dict[str, Any]:
    """Return the function of each command by its name, such as `store check`."""
    return dict(_leaves(typer.main.get_command(app), ()))


def _leaves(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    if not hasattr(command, "list_commands"):
        yield " ".join(words), command.callback
        return
    context = typer.Context(command)
    for name in command.list_commands(context):
        yield from _leaves(command.get_command(context, name), (*words, name))
