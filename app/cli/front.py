"""What Typer says, in Saccade's words: a wrong option is one line, and help names values without Python's types."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException
from typer.main import get_command

from saccade.shared.errors import NAME_LIMIT, SaccadeError, printable
from saccade.shared.wording import plain

_WORDS = {int: "N", float: "N", str: "TEXT", Path: "PATH"}


class FrontDoor(TyperGroup):
    """The commands of Saccade. Raises SaccadeError if an option or a command is wrong."""

    def make_context(self, *arguments: Any, **more: Any) -> Any:
        """Reads what stands before the command."""
        with _in_one_line():
            return super().make_context(*arguments, **more)

    def invoke(self, ctx: Any) -> Any:
        """Reads the rest, and calls the command."""
        with _in_one_line():
            return super().invoke(ctx)


@contextmanager
def _in_one_line() -> Iterator[None]:
    try:
        yield
    except TyperException as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # which is the help itself
            raise
        raise SaccadeError(_said(error)) from error


def _said(error: TyperException) -> str:
    """Returns in one line what is wrong with the words of the command line, and what to do."""
    context, parameter = getattr(error, "ctx", None), getattr(error, "param", None)
    where = f"see `{context.command_path if context else 'saccade'} --help`"
    if parameter is None:
        return f"{printable(error.format_message().rstrip('.'))}: {where}"
    name = name_of(parameter)
    if type(error).__name__ == "MissingParameter":
        return f"{name} is missing: {where}"
    wrong = next(iter(getattr(error.__cause__, "errors", list)()), None)
    if wrong is None:
        return f"{name}: {printable(error.message)}: {where}"
    choices = parameter.type_descriptor.choices
    need = f"choose from {', '.join(map(str, choices))}" if choices else plain(wrong)
    return f"{name} {printable(str(wrong['input']), NAME_LIMIT)}: {need}"


def name_of(parameter: Any) -> str:
    """Returns how an option or an argument is called."""
    return parameter.opts[0] if parameter.param_type_name == "option" else parameter.display_name_raw


def word_of(parameter: Any) -> str:
    """Returns the word that stands for the value of an option. It is empty for a flag and for an argument, which has
    its own name."""
    if parameter.param_type_name == "argument" or parameter.is_flag:
        return ""
    annotation = parameter.type_descriptor.annotation
    return parameter.metavar or _WORDS.get(annotation) or "|".join(map(str, get_args(annotation)))


def command_of(app: typer.Typer) -> Any:
    """Returns the command of an app, whose help says `N` and not `<int range>`."""
    command = get_command(app)
    _reword(command)
    return command


def _reword(command: Any) -> None:
    with typer.Context(command) as context:
        for parameter in command.get_params(context):  # with --help
            word = word_of(parameter)
            parameter.display_type_rich = lambda ctx, word=word: word
    for inner in getattr(command, "commands", {}).values():
        _reword(inner)
