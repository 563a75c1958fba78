"""`saccade objects add`, `learn` and `remove`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from saccade.app.objects.learning import learn
from saccade.app.objects.store import TURNTABLE, Card, keep, name_from, own_folder, remove, require_free
from saccade.app.run.display import say
from saccade.shared.config import set_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.render.foreign_mesh import read_mesh
from saccade.shared.render.objects import own_names


def add_meshes(paths: Sequence[Path], objects: str, *, name: str | None, unit: Literal["auto", "m", "cm", "mm"],
               up: Literal["auto", "z", "y"], ask: Callable[[str], bool] | None, console: Console) -> None:
    """Adds objects to a set of the user's and learns them. `ask` is asked whether an object is right.

    A mesh that cannot be read is one line on stderr, and nothing of it is kept. Raises SaccadeError if the set cannot
    be used, if a name is used twice, or if a mesh was refused.
    """
    folder, failed = own_folder(objects), 0
    names = [name_from(path, name) for path in paths]
    require_free(folder, names)
    for path, each in zip(paths, names, strict=True):
        try:
            imported = read_mesh(path, each, unit=unit, up=up)
        except SaccadeError as error:
            failed += 1
            print(f"saccade: {error}", file=sys.stderr)
            continue
        for note in imported.notes:
            say(console, f"{each}: {note}")
        kept = keep(folder, imported.mesh, Card(str(path), imported.unit, imported.up, imported.notes))
        size = " x ".join(f"{100 * side:.1f}" for side in imported.mesh.size_m)
        say(console, f"{each}: {size} cm; its picture is {kept / TURNTABLE}")
        if ask is not None and not ask(f"Is {each} right?"):
            remove(folder, each)
            say(console, f"{each} is not added: --unit and --up say how the file is meant")
    if failed < len(paths):
        learn_set(objects, console)
    if failed:
        raise SaccadeError(f"{failed} of {len(paths)} meshes are not added: see the lines above")


def learn_set(objects: str, console: Console) -> None:
    """Learns what is new or changed in a set. Raises SaccadeError if this fails."""
    folder = own_folder(objects)
    if not own_names(folder):
        say(console, f"{folder} has no objects")
        return
    with Progress(TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), console=console,
                  disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("learning", total=None)
        learnt = learn(objects, folder, lambda name, done, total: progress.update(
            bar, description=name, completed=done, total=total))
    known = len(own_names(folder))
    say(console, f"learnt {', '.join(learnt) or 'nothing new'}: {known} object{'s' * (known != 1)} in {folder}")
    say(console, f"use {'it' if known == 1 else 'them'} with `--agent open --objects {objects}`")


def remove_objects(objects: str, names: Sequence[str], console: Console) -> None:
    """Removes objects from a set, with what was learnt of them. Raises SaccadeError if one is not there."""
    folder = own_folder(objects)
    for name in names:
        remove(folder, name)
        say(console, f"removed {name} from {folder}")
    if own_names(folder) and set_folder(objects) is not None:
        learn(objects, folder, lambda *_: None)
