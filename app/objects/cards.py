"""The card and the picture of an object: they are written when it is added, and anew when its mesh is another one."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.app.objects.symmetry import symmetry_of
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_toml, read_bytes, replace_all, writing
from saccade.shared.model.object_card import CARD, read_card, symmetry_in
from saccade.shared.render.mesh import MAX_FILE_BYTES, MESH_FILE, Mesh, read_obj
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at
from saccade.shared.world.symmetry import NONE, symmetry_value, symmetry_words

TURNTABLE = "turntable.png"
VIEWS, VIEW_PX = 8, 160  # of the picture of an object
ELEVATION_RAD, HALF_ANGLE = 0.5, 0.35  # of its camera; the tangent of half the angle that the object covers
DIAGONAL_M = 0.5  # to which an object is scaled for its picture, so that it is between the near and the far plane


@dataclass(frozen=True)
class Card:
    """What is known of an object beside its mesh: where it came from, what was done with it, and its symmetry. The
    symmetry that was found is None if the user told the symmetry. If it was made from pictures, `views` says from how
    many, and `seen` which share of all directions they show."""

    source: str
    unit: str
    up: str
    notes: tuple[str, ...] = ()
    licence: str = ""
    symmetry: int = NONE
    symmetry_found: int | None = None
    views: int | None = None
    seen: float | None = None

    def text(self, mesh: Mesh, mesh_sha256: str) -> str:
        """The file's text, TOML."""
        seen = {} if self.views is None else {"views": self.views, "seen": round(self.seen or 0.0, 2)}
        return _lines({"name": mesh.name, "source": self.source, **seen, "unit": self.unit, "up": self.up,
                       "licence": self.licence, "notes": list(self.notes),
                       **_measured(mesh, mesh_sha256, self.symmetry, self.symmetry_found)})


def _measured(mesh: Mesh, mesh_sha256: str, symmetry: int, found: int | None) -> dict[str, Any]:
    """What a card says that follows from the mesh."""
    values = {"size_m": [round(float(side), 4) for side in mesh.size_m], "symmetry": symmetry_value(symmetry)}
    if found is not None:
        values["symmetry_found"] = symmetry_value(found)
    return values | {"mesh_sha256": mesh_sha256}


def _lines(values: Mapping[str, Any]) -> str:
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


def digest(folder: Path) -> str:
    """The hash of an object's mesh and texture. Raises SaccadeError if they cannot be read."""
    found, need = hashlib.sha256(), "mend it, or remove the object and add it again"
    paths = [folder / MESH_FILE, *(path for ending in ("png", "jpg", "jpeg")
                                   if (path := folder / f"texture_map.{ending}").is_file())]
    for path in paths:
        found.update(read_bytes(path, "mesh", need, MAX_FILE_BYTES))
    return found.hexdigest()


def refresh(folder: Path, tell: Callable[[str], None]) -> None:
    """Writes the card and the picture in an object's folder anew if they are of another mesh than the one that is
    there, or missing. What the user has told of the symmetry stays, and so does all else that the card says.

    `tell` is told what was done. Raises SaccadeError if the mesh or the card cannot be read, or if the two cannot be
    written.
    """
    card, sha256 = read_card(folder), digest(folder)
    if folder.is_symlink() or (card.get("mesh_sha256") == sha256 and (folder / TURNTABLE).is_file()):
        return
    mesh = read_obj(folder, folder.name)
    found, said = symmetry_of(mesh), symmetry_in(folder)
    is_found = "symmetry" not in card or ("symmetry_found" in card and said == symmetry_in(folder, "symmetry_found"))
    values = _measured(mesh, sha256, found if is_found else said, found)
    if "name" not in card:
        values = {"name": folder.name} | values
    with writing(folder, "object"):
        replace_all(folder, {CARD: _with(folder / CARD, values).encode(), TURNTABLE: png(turntable(mesh))})
    kept = "" if is_found else f"; its card keeps the symmetry that you have set, {symmetry_value(said)}"
    tell(f"{folder.name}: its card and its picture are new; turned about the vertical, it "
         f"{symmetry_words(found)}{kept}")


def _with(path: Path, values: Mapping[str, Any]) -> str:
    """The text of a card with other values; all else stays as the user has written it."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    for key in values:
        text = re.sub(rf"(?m)^{key}[ \t]*=.*\n?", "", text)
    try:
        parse_toml(text)  # a value may have been on several lines
    except ValueError as error:
        raise SaccadeError(f"object card {path} cannot be brought up to date: put each of {', '.join(values)} on one "
                           "line, or delete the file") from error
    return _lines(values) + text  # first, because what follows a table is in it


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture as the bytes of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def turntable(mesh: Mesh) -> NDArray[np.uint8]:
    """Views of an object from all around, side by side [160, 1280, 3]. Raises SaccadeError if OpenGL does not work."""
    focal = VIEW_PX / 2 / HALF_ANGLE
    scaled = replace(mesh, vertices_m=(mesh.vertices_m * (DIAGONAL_M / np.linalg.norm(mesh.size_m))).astype(np.float32))
    world = World((scaled,), size_px=VIEW_PX, intrinsics_px=np.array([focal, focal, VIEW_PX / 2, VIEW_PX / 2]))
    world.show_table(False)
    world.place({mesh.name: (np.zeros(3), 0.0)})
    away = DIAGONAL_M / 2 / HALF_ANGLE * 1.1
    cameras = [look_at(away * direction(azimuth, ELEVATION_RAD), np.zeros(3))
               for azimuth in 2 * np.pi / VIEWS * np.arange(VIEWS)]
    picture = np.concatenate([world.render(camera) for camera in cameras], axis=1)
    world.close()
    return picture
