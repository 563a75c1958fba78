"""Objects of several sets, such as `milk,ketchup,pantry:soup_can`: they are put together as a set of their own."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from saccade.app.objects.cards import Card
from saccade.app.objects.learning import learn
from saccade.app.objects.store import alone_in, keep
from saccade.shared.config import BUILT_IN_SETS, set_folder, sets_folder
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import writing
from saccade.shared.model.weights import OPEN
from saccade.shared.render.objects import load_mesh, names_of, own_names, ycb_folder

Member = tuple[str, str]  # a set and an object in it


def assembled(objects: str, architecture: str) -> str:
    """The folder of a set with the listed objects, which is made if it is not there. It is learnt if the architecture
    needs no training.

    Raises SaccadeError if an object is not there, is in several sets, or shares its name with another one.
    """
    members = members_of(objects)
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "saccade" / "lists"
    folder = cache / hashlib.sha256("\n".join(f"{_folder(s) or s}:{n}" for s, n in members).encode()).hexdigest()[:16]
    there = own_names(folder)
    with writing(folder, "list of objects"):
        folder.mkdir(parents=True, exist_ok=True)
        for object_set, name in members:
            if name in there:
                continue
            where = _folder(object_set)
            if where is None:
                keep(folder, load_mesh(object_set, name), Card(f"made by code, of {object_set!r}", "m", "z"))
            else:
                load_mesh(object_set, name)  # what is wrong with it is said now
                (folder / name).unlink(missing_ok=True)
                (folder / name).symlink_to((where / name).resolve())
    if architecture == OPEN:
        with alone_in(folder):
            if refused := learn(str(folder), folder, lambda *_: None).refused:
                raise SaccadeError(next(iter(refused.values())))
    return str(folder)


def members_of(objects: str) -> list[Member]:
    """The listed objects: NAME, SET:NAME, or SET for all of a set. Raises SaccadeError, see `assembled`."""
    members: list[Member] = []
    for item in filter(None, (part.strip() for part in objects.split(","))):
        object_set, colon, name = item.rpartition(":")
        if colon:
            if name not in names_of(object_set):
                raise SaccadeError(f"object {told(name)} is not in {object_set!r}: choose from "
                                   f"{', '.join(names_of(object_set))}")
            members.append((object_set, name))
        elif item in _sets():
            members += [(item, name) for name in names_of(item)]
        else:
            members.append((_set_with(item), item))
    names = [name for _, name in members]
    for name in names:
        if names.count(name) > 1:
            raise SaccadeError(f"object {name!r} is listed twice: name it once, as SET:NAME if two sets have one")
    if not members:
        raise SaccadeError(f"--objects {told(objects)} lists nothing: write NAME,SET:NAME,SET")
    return sorted(members, key=lambda member: member[1])


def _set_with(name: str) -> str:
    found = [each for each in _sets() if name in names_of(each)]
    if len(found) > 1:
        raise SaccadeError(f"object {name!r} is in {' and in '.join(found)}: write {found[0]}:{name}")
    if not found:
        raise SaccadeError(f"object {told(name)} is in none of the sets {', '.join(_sets())}: `saccade objects list` "
                           "shows what is in one")
    return found[0]


def _sets() -> tuple[str, ...]:
    """All sets that can be named: the user's that hold something, and those that are built in."""
    try:
        own = sorted(entry.name for entry in sets_folder().iterdir() if own_names(entry))
    except OSError:
        own = []
    return (*own, *BUILT_IN_SETS)


def _folder(object_set: str) -> Path | None:
    """Where a set's objects are files. None if they are made by code."""
    return ycb_folder() if object_set == "ycb" else set_folder(object_set)
