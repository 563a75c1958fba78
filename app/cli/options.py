"""Options that several commands have, and what their texts mean. Loads nothing heavy before it is asked."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from saccade.shared.errors import SaccadeError

Objects = Annotated[Literal["pantry", "ycb"] | None, typer.Option(help="Object set.", show_default="pantry")]
Names = Annotated[str | None, typer.Option(help="Use only these objects of the set, such as a,b.", metavar="NAMES")]
ConfigFile = Annotated[Path | None, typer.Option(
    help="Configuration file, TOML or JSON, or the name of a preset. Options take precedence over it.")]
Values = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE",
                                                  help="Set a key of the configuration, such as planner.step_m=0.03. "
                                                       "Can be given several times.")]
WeightsFolder = Annotated[Path | None, typer.Option(
    help="Folder of the trained weights.", show_default="weights/<set>")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of everything random.", show_default="0")]
Yaw = Annotated[Literal["random", "fixed"] | None, typer.Option(
    help="Whether drawn objects are turned about the vertical axis.")]
ScenesFile = Annotated[Path | None, typer.Option(help="Scenes file (JSON).")]


def configured(path: Path | None, given: dict[str, Any], values: list[str] | None) -> Any:
    """The configuration: the file's, then the options that were given, then `--set`."""
    from saccade.shared.config import load

    options = {key: value for key, value in given.items() if value is not None}
    return load(path).with_values(options | dict(parse_value(text) for text in values or ()))


def parse_value(text: str) -> tuple[str, Any]:
    """KEY=VALUE as (key, value): JSON where it is JSON, else text."""
    from json import loads

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise SaccadeError(f"--set {text!r}: write KEY=VALUE, such as planner.step_m=0.03")
    try:
        return key, loads(value)
    except ValueError:
        return key, value


def split_names(names: str | None) -> list[str] | None:
    """The objects in a,b."""
    return None if names is None else [name.strip() for name in names.split(",") if name.strip()]


def numbers(text: str | None) -> list[float] | None:
    """The numbers in a,b; their count and size are for the configuration to check."""
    try:
        return None if text is None else [float(part) for part in text.split(",")]
    except ValueError as error:
        raise SaccadeError(f"--intrinsics {text!r}: write fx,fy,cx,cy, such as 615,615,320,240") from error


def wide(console: Any) -> Any:
    """Room for a table where nobody looks at a terminal: in a file or a pipe."""
    if not console.is_terminal:
        console.width = max(console.width, 140)
    return console


def command_line() -> str:
    """The command as it was given."""
    return shlex.join(["saccade", *sys.argv[1:]])
