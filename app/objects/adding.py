"""`saccade objects add`, `learn` and `remove`."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from saccade.app.objects.cards import TURNTABLE, Card, png, refresh, turntable
from saccade.app.objects.learning import learn, require_size
from saccade.app.objects.store import (
    alone_in,
    keep,
    name_from,
    own_folder,
    remove,
    require_free,
    require_there,
)
from saccade.app.objects.symmetry import symmetry_of
from saccade.app.objects.views.meshing import mesh_from_views
from saccade.app.objects.views.pictures import Told
from saccade.app.run.display import say
from saccade.shared.errors import SaccadeError
from saccade.shared.render.foreign_mesh import read_mesh
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.objects import names_of
from saccade.shared.world.symmetry import symmetry_words

Ask = Callable[[str], bool]


def add_meshes(paths: Sequence[Path], objects: str, *, name: str | None, unit: Literal["auto", "m", "cm", "mm"],
               up: Literal["auto", "z", "y"], ask: Ask | None, console: Console, symmetry: int | None = None) -> None:
    """Adds objects to a set of the user's and learns them. `ask` is asked whether an object is right. Without a
    `symmetry` that of each object is found by looking at it from around.

    A mesh that cannot be read is one line on stderr, and nothing of it is kept. Raises SaccadeError if the set cannot
    be used, if a name is used twice, or if a mesh was refused.
    """
    folder, failed, added = own_folder(objects), 0, 0
    names = [name_from(path, name) for path in paths]
    with alone_in(folder):
        require_free(folder, names)
        for path, each in zip(paths, names, strict=True):
            try:
                imported = read_mesh(path, each, unit=unit, up=up)
                require_size(imported.mesh.size_m, each)
            except SaccadeError as error:
                failed += 1
                print(f"saccade: {error}", file=sys.stderr)
                continue
            card = Card(str(path), imported.unit, imported.up, imported.notes)
            added += _add(folder, imported.mesh, card, ask, console, symmetry)
        if added:
            _learn(objects, folder, console)
    if failed:
        raise SaccadeError(f"{failed} of {len(paths)} meshes could not be added: see above")


def add_views(source: Path, objects: str, *, name: str | None, told: Told, masks: Path | None, ask: Ask | None,
              console: Console, symmetry: int | None = None) -> None:
    """Adds an object to a set of the user's from pictures around it, and learns it. `source` is their folder or a
    video, `told` what is known of the camera, and `masks` a folder with a mask for each picture; for the rest see
    `add_meshes`.

    Raises SaccadeError if nothing can be made of the pictures; then nothing is kept.
    """
    folder, known = own_folder(objects), name_from(source, name)
    with alone_in(folder):
        require_free(folder, [known])
        made = mesh_from_views(source, known, told, masks)
        card = Card("views", "m", "z", made.notes, views=made.views, seen=made.seen)
        if _add(folder, made.mesh, card, ask, console, symmetry, "--scale, --up and --symmetry say how they are meant"):
            _learn(objects, folder, console)


def _add(folder: Path, mesh: Mesh, card: Card, ask: Ask | None, console: Console, symmetry: int | None,
         advice: str = "--unit, --up and --symmetry say how the file is meant") -> bool:
    """Keeps a mesh with its card, to which the symmetry is added, if it is right. Returns whether it is."""
    picture = turntable(mesh)
    found = symmetry_of(mesh) if symmetry is None else None
    known = symmetry if found is None else found
    assert known is not None  # it is one of the two
    for note in card.notes:
        say(console, f"{mesh.name}: {note}")
    size = " x ".join(f"{100 * side:.1f}" for side in mesh.size_m)
    card = replace(card, symmetry=known, symmetry_found=found)
    say(console, f"{mesh.name}: turned about the vertical, it {symmetry_words(known)}")
    if ask is None:
        say(console, f"{mesh.name}: {size} cm; its picture is {keep(folder, mesh, card, picture) / TURNTABLE}")
        return True
    with tempfile.TemporaryDirectory(prefix="saccade-") as place:  # so that nothing is kept before the answer
        say(console, f"{mesh.name}: {size} cm; its picture is {_saved(picture, Path(place))}")
        right = ask(f"Is {mesh.name} right?")
    if right:
        keep(folder, mesh, card, picture)
    else:
        say(console, f"{mesh.name} is not added: {advice}")
    return right


def _saved(picture: NDArray[np.uint8], folder: Path) -> Path:
    (folder / TURNTABLE).write_bytes(png(picture))
    return folder / TURNTABLE


def learn_set(objects: str, console: Console) -> None:
    """Learns what is new or changed in a set, and brings the cards and the pictures up to date. Raises SaccadeError if
    it is not there, or if something cannot be learnt."""
    folder = own_folder(objects)
    names_of(objects)  # that there are some
    with alone_in(folder):
        _learn(objects, folder, console)


def _learn(objects: str, folder: Path, console: Console) -> None:
    with Progress(TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), console=console,
                  disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("learning", total=None)
        done = learn(objects, folder, lambda name, done, total: progress.update(
            bar, description=name, completed=done, total=total))
    for line in done.refused.values():
        print(f"saccade: {line}", file=sys.stderr)
    known = len(names_of(objects)) - len(done.refused)
    wrong = _refreshed(folder, [name for name in names_of(objects) if name not in done.refused], console)
    say(console, f"learnt {', '.join(done.names) or 'nothing new'}: {known} object{'s' * (known != 1)} in {folder}")
    if known:
        say(console, f"use {'it' if known == 1 else 'them'} with `--objects {objects}`")
    if done.refused:
        raise SaccadeError(f"{len(done.refused)} of the set's objects could not be learnt: see above")
    if wrong:
        raise SaccadeError(f"{wrong} of the set's cards could not be brought up to date: see above")


def _refreshed(folder: Path, names: Sequence[str], console: Console) -> int:
    """Brings cards and pictures up to date. Returns how many could not be."""
    wrong = 0
    for name in names:
        try:
            refresh(folder / name, lambda text: say(console, text))
        except SaccadeError as error:
            wrong += 1
            print(f"saccade: {error}", file=sys.stderr)
    return wrong


def remove_objects(objects: str, names: Sequence[str], console: Console) -> None:
    """Removes objects from a set, with what was learnt of them. Raises SaccadeError if one is not there."""
    folder = own_folder(objects)
    require_there(folder, names)
    with alone_in(folder):
        for name in names:
            remove(folder, name)
            say(console, f"removed {name} from {folder}")
        learn(objects, folder, lambda *_: None)
