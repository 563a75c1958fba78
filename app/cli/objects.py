"""`saccade objects`: objects of one's own."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

app = typer.Typer(no_args_is_help=True, help="Add, list, show, learn and remove objects of your own.")
Set = Annotated[str, typer.Option("--set", metavar="SET", help="Set of your own, or its folder.")]
NAME = typer.Argument(metavar="NAME", help="Object of the set.")


@app.command()
def add(meshes: Annotated[list[Path] | None, typer.Argument(
            metavar="[MESH...]", help="OBJ, GLB, glTF, PLY or STL files.", show_default=False)] = None, *,
        views: Annotated[Path | None, typer.Option(
            metavar="VIDEO|FOLDER", help="Instead of a mesh: a video or a folder of pictures from around the object. "
                                         "Needs --poses.")] = None,
        poses: Annotated[Path | None, typer.Option(
            help="File or folder with the camera's poses, in any format that `saccade poses show` reads.")] = None,
        masks: Annotated[Path | None, typer.Option(
            metavar="FOLDER", help="Masks of the pictures, with the same names, white where the object is. Not needed "
                                   "before a plain background.")] = None,
        intrinsics: Annotated[str | None, typer.Option(
            metavar="fx,fy,cx,cy", help="Intrinsics of the pictures, in pixels.",
            show_default="from the file of the poses, or from EXIF data")] = None,
        scale: Annotated[float, typer.Option(help="Length in metres of the unit of the poses.")] = 1.0,
        name: Annotated[str | None, typer.Option(help="Name of the object.", show_default="from the file")] = None,
        objects: Set = "my",
        unit: Annotated[Literal["auto", "m", "cm", "mm"], typer.Option(
            help="Unit of the file's lengths. Without it, that in which the object is of household size.")] = "auto",
        up: Annotated[Literal["auto", "z", "y", "x", "-x", "-y", "-z"], typer.Option(
            help="Which axis of the mesh's file (y or z) or of the poses' world points up.")] = "auto",
        symmetry: Annotated[str | None, typer.Option(
            help="How the object looks the same when it is turned about the vertical: none, continuous, or how often, "
                 "such as 4.", show_default="found by looking at it from around")] = None,
        yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Add objects to a set of your own, from their meshes or from pictures around one, and learn them."""
    from rich.console import Console

    from saccade.app.objects.adding import add_meshes, add_views
    from saccade.shared.errors import SaccadeError
    from saccade.shared.world.symmetry import symmetry_from

    try:
        known = None if symmetry is None else symmetry_from(symmetry)
    except ValueError as error:
        raise SaccadeError(f"--{error}") from error
    if not yes and not sys.stdin.isatty():
        raise SaccadeError("nobody can be asked without a terminal whether an object is right: add --yes")
    ask = None if yes else _ask
    if views is not None:
        if meshes or unit != "auto":
            raise SaccadeError("--views takes the place of a mesh: leave the meshes and --unit out; --scale is the "
                               "unit of the poses")
        add_views(views, objects, name=name, told=_told(poses, intrinsics, scale, None if up == "auto" else up),
                  masks=masks, ask=ask, console=Console(), symmetry=known)
        return
    if poses is not None or masks is not None or intrinsics is not None or scale != 1.0:
        raise SaccadeError("--poses, --masks, --intrinsics and --scale are for pictures: give them with --views")
    if not meshes:
        raise SaccadeError("nothing is given to add: give meshes, or pictures with --views and --poses")
    if up not in ("auto", "z", "y"):
        raise SaccadeError(f"--up {up}: in the file of a mesh z or y points up; the others are for --views")
    if name is not None and len(meshes) > 1:
        raise SaccadeError("--name is for one mesh: add the others without it, or one by one")
    add_meshes(meshes, objects, name=name, unit=unit, up=up, ask=ask, console=Console(), symmetry=known)


def _told(poses: Path | None, intrinsics: str | None, scale: float, up: Any) -> Any:
    """What is told of the camera that took the pictures."""
    from saccade.app.cli.texts import numbers
    from saccade.app.objects.views.pictures import Told
    from saccade.services.camera.trajectories.trajectory import Asked
    from saccade.shared.errors import SaccadeError

    if poses is None:
        raise SaccadeError("--views needs --poses: where the camera was at each picture")
    if not (math.isfinite(scale) and scale > 0):
        raise SaccadeError(f"--scale {scale:g}: give the length in metres of the unit of the poses")
    given = numbers(intrinsics)
    if given is not None and not (len(given) == 4 and all(map(math.isfinite, given)) and min(given[:2]) > 0):
        raise SaccadeError(f"--intrinsics {intrinsics!r}: write fx,fy,cx,cy, such as 615,615,320,240")
    return Told(poses, None if given is None else (given[0], given[1], given[2], given[3]), Asked(up=up, scale=scale))


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
