"""Sets of objects of the user's: a set is a folder, and an object is a folder in it with its mesh and its card."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.app.objects.cards import TURNTABLE, Card, digest, png, turntable
from saccade.shared.config import set_folder
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import writing
from saccade.shared.model.object_card import CARD
from saccade.shared.render.mesh import MESH_FILE, Mesh
from saccade.shared.render.objects import own_names
from saccade.shared.wording import WORLD

if sys.platform != "win32":
    import fcntl

TEXTURE = "texture_map.png"
RESERVED = "weights"  # what is learnt of a set lies in folders whose names begin so


def own_folder(objects: str) -> Path:
    """The folder of a set of the user's. Raises SaccadeError if the set is built in, or if no set can be named so."""
    folder = set_folder(objects)
    if not objects:
        raise SaccadeError("--set is empty: give the name of a set of your own, or its folder")
    if folder is None:
        raise SaccadeError(f"object set {objects!r} comes with Saccade and stays as it is: name a set of your own")
    if not re.fullmatch(WORLD, folder.name):
        raise SaccadeError(f"object set {told(folder.name)}: give a name of at most 64 letters, digits, - and _")
    return folder


def name_from(path: Path, given: str | None) -> str:
    """The name of an object: the given one, or that of its file. Raises SaccadeError if none can be had."""
    generic = ("textured", "mesh", "model", "scene", "object", "untitled", "images", "frames",
               "views", "video")
    stem = path.parent.name if path.stem.lower() in generic and path.parent.name else path.stem
    name = given if given is not None else re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_")[:64]
    if not re.fullmatch(WORLD, name) or name.startswith(("-", RESERVED)):
        raise SaccadeError(f"{path}: {told(name)} cannot be the name of an object: give one of at most 64 letters, "
                           f"digits, - and _ with --name, which does not begin with - or {RESERVED}")
    return name


def require_free(folder: Path, names: Sequence[str]) -> None:
    """Raises SaccadeError if one of these names is used twice, or is in the set already."""
    for number, name in enumerate(names):
        if name in names[:number]:
            raise SaccadeError(f"two of the meshes have the name {name!r}: add them one by one, with --name")
        if (folder / name).exists():
            raise SaccadeError(f"object {name!r} is in {folder} already: give another name with --name, or remove it "
                               f"first with `saccade objects remove {name}`")


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Only one command at a time changes a set. What an earlier one left half done is taken away. Raises SaccadeError
    if another one is at work, or if the folder cannot be used."""
    with writing(folder, "object set"):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SaccadeError(f"another command changes the object set {folder}: wait until it is done") from error
        for left in (*folder.glob(".adding-*"), *folder.glob(".removed-*")):
            shutil.rmtree(left, ignore_errors=True)
        yield
    finally:
        os.close(lock)


def keep(folder: Path, mesh: Mesh, card: Card, picture: NDArray[np.uint8] | None = None) -> Path:
    """Puts an object into a set, at once or not at all; `picture` is its turntable. Returns its folder. Raises
    SaccadeError if this fails."""
    target = folder / mesh.name
    with writing(target, "object"):
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".adding-", dir=folder))
        try:
            (staging / MESH_FILE).write_text(obj_text(mesh))
            Image.fromarray(mesh.texture).save(staging / TEXTURE)
            (staging / TURNTABLE).write_bytes(png(turntable(mesh) if picture is None else picture))
            (staging / CARD).write_text(card.text(mesh, digest(staging)), encoding="utf-8")
            staging.chmod(0o755)
            os.rename(staging, target)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    return target


def require_there(folder: Path, names: Sequence[str]) -> None:
    """Raises SaccadeError if one of these objects is not in the set."""
    for name in names:
        if name not in own_names(folder):
            there = ", ".join(own_names(folder)) or "none"
            raise SaccadeError(f"object {told(name)} is not in {folder}: it holds {there}")


def remove(folder: Path, name: str) -> None:
    """Takes an object out of a set. Raises SaccadeError if it cannot be removed."""
    with writing(folder / name, "object"):
        gone = folder / f".removed-{name}"
        shutil.rmtree(gone, ignore_errors=True)
        os.rename(folder / name, gone)  # at once, whatever comes
        shutil.rmtree(gone)


def obj_text(mesh: Mesh) -> str:
    """A mesh as the text of a Wavefront OBJ file, as `read_obj` reads it."""
    text = io.StringIO()
    np.savetxt(text, mesh.vertices_m, "v %.6f %.6f %.6f")
    np.savetxt(text, mesh.texcoords, "vt %.6f %.6f")
    np.savetxt(text, np.repeat(mesh.faces + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
    return text.getvalue()
