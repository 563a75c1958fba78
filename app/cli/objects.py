"""`saccade objects`: objects of one's own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer(no_args_is_help=True, help="Add, list, show, learn and remove objects of your own.")
Set = Annotated[str, typer.Option("--set", metavar="SET", help="Set of your own, or its folder.")]
NAME = typer.Argument(metavar="NAME", help="Object of the set.")


@app.command()
def add(meshes: Annotated[list[Path], typer.Argument(metavar="MESH...", help="OBJ, GLB, glTF, PLY or STL files.")], *,
        name: Annotated[str | None, typer.Option(help="Name of the object.", show_default="from the file")] = None,
        objects: Set = "my",
        unit: Annotated[Literal["auto", "m", "cm", "mm"], typer.Option(
            help="Unit of the file's lengths. Without it, that in which the object is of household size.")] = "auto",
        up: Annotated[Literal["auto", "z", "y"], typer.Option(
            help="Which axis of the file points up.")] = "auto",
        symmetry: Annotated[str | None, typer.Option(
            help="How the object looks the same when it is turned about the vertical: none, continuous, or how often, "
                 "such as 4.", show_default="found by looking at it from around")] = None,
        yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Add objects to a set of your own, from their meshes, and learn them."""
    from rich.console import Console

    from saccade.app.objects.adding import add_meshes
    from saccade.shared.errors import SaccadeError
    from saccade.shared.world.symmetry import symmetry_from

    try:
        known = None if symmetry is None else symmetry_from(symmetry)
    except ValueError as error:
        raise SaccadeError(f"--{error}") from error
    if not yes and not sys.stdin.isatty():
        raise SaccadeError("nobody can be asked without a terminal whether an object is right: add --yes")
    if name is not None and len(meshes) > 1:
        raise SaccadeError("--name is for one mesh: add the others without it, or one by one")
    add_meshes(meshes, objects, name=name, unit=unit, up=up, ask=None if yes else _ask, console=Console(),
               symmetry=known)


@app.command("list")
def list_objects(*, objects: Set = "my") -> None:
    """List the objects of a set."""
    from rich.console import Console

    from saccade.app.objects.showing import list_set

    list_set(objects, Console())


@app.command()
def show(name: Annotated[str, NAME], *, objects: Set = "my",
         out: Annotated[Path | None, typer.Option(
             help="Also write a page about it (NAME.md) with pictures.", metavar="FOLDER")] = None) -> None:
    """Show an object: its size, its symmetry, its picture, and which others of the set look most like it."""
    from rich.console import Console

    from saccade.app.objects.showing import show_object

    show_object(objects, name, Console(), out)


@app.command()
def learn(*, objects: Set = "my") -> None:
    """Learn the objects of a set that are new or changed. The same command continues after an interruption."""
    from rich.console import Console

    from saccade.app.objects.adding import learn_set

    learn_set(objects, Console())


@app.command()
def remove(names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Objects of the set.")], *,
           objects: Set = "my") -> None:
    """Remove objects from a set."""
    from rich.console import Console

    from saccade.app.objects.adding import remove_objects

    remove_objects(objects, names, Console())


def _ask(question: str) -> bool:
    from saccade.shared.errors import SaccadeError

    try:
        return typer.confirm(question, default=True)
    except typer.Abort as error:
        raise SaccadeError("stopped at the question: this object is not added") from error
