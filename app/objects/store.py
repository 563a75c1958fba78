"""Sets of objects of the user's: a set is a folder, and an object is a folder in it with its mesh and its card."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.config import set_folder
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import writing
from saccade.shared.render.mesh import MESH_FILE, Mesh
from saccade.shared.render.objects import own_names
from saccade.shared.render.world import World
from saccade.shared.wording import WORLD
from saccade.shared.world.geometry import direction, look_at

if sys.platform != "win32":
    import fcntl

CARD, TEXTURE, TURNTABLE = "object.toml", "texture_map.png", "turntable.png"
RESERVED = "weights"  # what is learnt of a set lies in folders whose names begin so
VIEWS, VIEW_PX = 8, 160  # of the picture of an object
ELEVATION_RAD, HALF_ANGLE = 0.5, 0.35  # of its camera; the tangent of half the angle that the object covers


@dataclass(frozen=True)
class Card:
    """What is known of an object beside its mesh: where it came from, and what was done with it."""

    source: str
    unit: str
    up: str
    notes: tuple[str, ...] = ()
    licence: str = ""

    def text(self, mesh: Mesh) -> str:
        """The file's text, TOML."""
        values = {"name": mesh.name, "size_m": [round(float(side), 4) for side in mesh.size_m], "source": self.source,
                  "unit": self.unit, "up": self.up, "licence": self.licence, "notes": list(self.notes)}
        return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


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
    generic = ("textured", "mesh", "model", "scene", "object", "untitled")
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
    """Puts an object into a set, at once or not at all; `picture` is that of `turntable`. Returns its folder. Raises
    SaccadeError if this fails."""
    target = folder / mesh.name
    with writing(target, "object"):
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".adding-", dir=folder))
        try:
            (staging / MESH_FILE).write_text(obj_text(mesh))
            Image.fromarray(mesh.texture).save(staging / TEXTURE)
            Image.fromarray(turntable(mesh) if picture is None else picture).save(staging / TURNTABLE)
            (staging / CARD).write_text(card.text(mesh), encoding="utf-8")
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


def turntable(mesh: Mesh) -> NDArray[np.uint8]:
    """Views of an object from all around, side by side [160, 1280, 3]. Raises SaccadeError if OpenGL does not work."""
    focal = VIEW_PX / 2 / HALF_ANGLE
    world = World((mesh,), size_px=VIEW_PX, intrinsics_px=np.array([focal, focal, VIEW_PX / 2, VIEW_PX / 2]))
    world.show_table(False)
    world.place({mesh.name: (np.zeros(3), 0.0)})
    away = float(np.linalg.norm(mesh.size_m)) / 2 / HALF_ANGLE * 1.1
    cameras = [look_at(away * direction(azimuth, ELEVATION_RAD), np.zeros(3))
               for azimuth in 2 * np.pi / VIEWS * np.arange(VIEWS)]
    picture = np.concatenate([world.render(camera) for camera in cameras], axis=1)
    world.close()
    return picture
