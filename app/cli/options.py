"""Options that several commands have. Loads nothing heavy."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

# A test holds this to the registry, which loads too much for a help text.
AGENTS = ("sceneccn (Saccade's own), paper, open, posecnn, posecnn-infogain, render-and-compare, lexa, random-walk, "
          "still, or oracle (which knows the goal's pose)")
AGENT_DEFAULT = "sceneccn, or open for objects of your own or that lie, photographs and any other light"
Objects = Annotated[str | None, typer.Option(
    help="Object set: pantry, ycb, one of your own, or the folder of one; or a list such as milk,pantry:soup_can.",
    metavar="SET", show_default="pantry")]
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


def wide(console: Any) -> Any:
    """Room for a table where nobody looks at a terminal: in a file or a pipe."""
    if not console.is_terminal:
        console.width = max(console.width, 140)
    return console


def command_line() -> str:
    """The command as it was given."""
    return shlex.join(["saccade", *sys.argv[1:]])
