"""Reads Wavefront OBJ files as programs and scanners write them: faces of any number of corners, relative indices,
several parts and materials, names with spaces, colours of vertices.

The library that reads the other kinds counts relative indices from the end of the file, reads one material file only
and no texture with options. These files need more.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import MIB, read_bytes
from saccade.shared.render.mesh import MAX_FILE_BYTES
from saccade.shared.render.mesh_parts import (
    EXPORT_AGAIN,
    GREY,
    MAX_FACES,
    TOO_MANY,
    Folder,
    Loaded,
    Part,
    Unit,
    coloured,
)

MAX_MATERIAL_BYTES = 4 * MIB
MAX_COMMENT = 200  # characters in which a unit is looked for
_UNIT = re.compile(r"\b(milli|centi|)met(?:er|re)s?\b")
_UNITS: dict[str, Unit] = {"milli": "mm", "centi": "cm", "": "m"}
_OPTION = re.compile(r"\s*-(?:[sot](?:\s+[-+.\deE]+){1,3}|mm(?:\s+[-+.\deE]+){2}|(?:blendu|blendv|cc|clamp|bm|imfchan|"
                     r"texres|boost)\s+\S+)\s+")


@dataclass
class Material:
    """A material: its colour from 0 to 1, and the name of its texture."""

    colour: tuple[float, ...] | None = None
    texture: str | None = None


@dataclass
class Wavefront:
    """What the lines of an OBJ file say so far. A triangle has three corners: vertex and texture coordinate (or -1)."""

    vertices: array = field(default_factory=lambda: array("d"))
    colours: array = field(default_factory=lambda: array("d"))
    texcoords: array = field(default_factory=lambda: array("d"))
    triangles: dict[str, array] = field(default_factory=dict)  # by material; "" is none
    libraries: list[str] = field(default_factory=list)
    unit: Unit | None = None
    material: str = ""
    faces: int = 0  # so many triangles, or more if it was too many

    @property
    def is_too_large(self) -> bool:
        return self.faces > MAX_FACES or max(len(self.vertices), len(self.texcoords)) > 9 * MAX_FACES

    def take(self, line: str) -> None:
        """Takes one line. Raises ValueError or IndexError if it is damaged."""
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            numbers = [float(number) for number in rest.split()]
            self.vertices.extend((numbers[0], numbers[1], numbers[2]))
            if len(numbers) >= 6:
                self.colours.extend(numbers[3:6])
        elif word == "vt":
            numbers = [float(number) for number in rest.split()]
            self.texcoords.extend((numbers[0], numbers[1] if len(numbers) > 1 else 0.0))
        elif word == "f":
            self._take_face(rest.split())
        elif word == "usemtl":
            self.material = rest.strip()
        elif word == "mtllib":
            self.libraries.append(rest.strip())
        elif word.startswith("#") and self.unit is None:
            comment = line[:MAX_COMMENT].lower()
            if "unit" in comment and (found := _UNIT.search(comment)):
                self.unit = _UNITS[found[1]]

    def _take_face(self, words: list[str]) -> None:
        if len(words) < 3:
            raise ValueError("a face has fewer than three corners")
        self.faces += len(words) - 2
        if self.is_too_large:
            return
        corners = [self._corner(word.split("/")) for word in words]
        triangles = self.triangles.setdefault(self.material, array("q"))
        for second, third in pairwise(corners[1:]):
            for corner in (corners[0], second, third):
                triangles.extend(corner)

    def _corner(self, parts: list[str]) -> tuple[int, int]:
        vertex = _number(parts[0], len(self.vertices) // 3)
        return vertex, _number(parts[1], len(self.texcoords) // 2) if len(parts) > 1 and parts[1] else -1


def _number(text: str, count: int) -> int:
    """The number from 0 of what an index names, which counts from 1, or back from the `count` that are there so far."""
    index = int(text) if len(text) <= 18 else 0
    number = index - 1 if index > 0 else count + index
    if index == 0 or number < 0 or number > 3 * MAX_FACES:
        raise ValueError("a face refers to a vertex that is not there")
    return number


def read_wavefront(path: Path, folder: Folder) -> Loaded:
    """Reads an OBJ file with its materials and textures. Raises SaccadeError if something is missing or damaged."""
    text = _text(read_bytes(path, "mesh", EXPORT_AGAIN, MAX_FILE_BYTES))
    if text.count("\nf ") > MAX_FACES:
        raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    found, text, start = Wavefront(), text.replace("\\\n", " "), 0
    try:
        for line in re.finditer(r"[^\n]+", text):  # one by one, because a list of them all would be large
            start = line.start()
            found.take(line[0].replace("\t", " "))
            if found.is_too_large:
                raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    except (ValueError, IndexError, OverflowError) as error:
        line_number = text.count("\n", 0, start) + 1
        raise SaccadeError(f"mesh {path} is damaged (line {line_number}: {error}): {EXPORT_AGAIN}") from error
    notes: list[str] = []
    materials = _read_materials(found, folder, notes)
    points, texcoords = np.array(found.vertices).reshape(-1, 3), np.array(found.texcoords).reshape(-1, 2)
    try:
        parts = [_part(found, points, texcoords, materials, name, folder, notes) for name in found.triangles]
    except IndexError as error:
        raise SaccadeError(f"mesh {path} is damaged (a face refers to a vertex that is not there): "
                           f"{EXPORT_AGAIN}") from error
    unit = (found.unit, "as a comment in the file says") if found.unit else None
    return Loaded(parts, notes, "OBJ", unit=unit)


def _text(data: bytes) -> str:
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def _part(found: Wavefront, points: NDArray, texcoords: NDArray, materials: dict[str, Material], name: str,
          folder: Folder, notes: list[str]) -> Part:
    pairs = np.array(found.triangles[name], dtype=np.int64).reshape(-1, 3, 2)
    corners = points[pairs[..., 0]]
    material = materials.get(name)
    if material is not None and material.texture is not None:
        image = folder.image(material.texture)
        if (pairs[..., 1] >= 0).all():
            return Part(corners, texcoords[pairs[..., 1]], image)
        notes.append(f"The faces with the material {told(name)} have no texture coordinates, so they get the mean "
                     "colour of its texture.")
        return coloured(corners, np.asarray(image, dtype=np.float64).mean((0, 1)).round())
    if len(found.colours) == len(found.vertices):
        return coloured(corners, _bytes(np.array(found.colours)).reshape(-1, 3)[pairs[..., 0]])
    if material is not None and material.colour is not None:
        return coloured(corners, _bytes(np.array(material.colour)))
    missing = f"its material {told(name)} is in no material file or has no colour" if name else "it names no material"
    notes.append(f"The mesh{' in part' if len(found.triangles) > 1 else ''} has no colour ({missing}), so it is grey.")
    return coloured(corners, GREY)


def _bytes(colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """Colours from 0 to 1, or from 0 to 255 as some programs write them, as 0 to 255."""
    if not np.isfinite(colours).all():
        colours = np.nan_to_num(colours)
    return np.clip(colours * (1.0 if colours.max(initial=0.0) > 1.0 else 255.0), 0, 255).round()


def _read_materials(found: Wavefront, folder: Folder, notes: list[str]) -> dict[str, Material]:
    """The materials of all material files. A note says which file is missing."""
    materials: dict[str, Material] = {}
    for named in found.libraries:
        # A line names one file, in which spaces may occur, or several.
        for name in [named] if folder.find(named) or not named else named.split():
            if folder.find(name) is not None:
                _parse_materials(_text(folder.read(name, "material file")[:MAX_MATERIAL_BYTES]).split("\n"), materials)
            elif not any(told(named) in note for note in notes):
                notes.append(f"The material file {told(named)} is not beside the mesh, so its colours and textures are "
                             f"unknown: put it into {folder.path} to have them.")
    return materials


def _parse_materials(lines: Iterable[str], materials: dict[str, Material]) -> None:
    material = Material()
    for line in lines:
        word, _, rest = line.replace("\t", " ").strip().partition(" ")
        if word == "newmtl":
            material = materials.setdefault(rest.strip(), Material())
        elif word.lower() == "map_kd":
            material.texture = _texture_name(rest) or None
        elif word == "Kd":
            try:
                numbers = tuple(float(number) for number in rest.split()[:3])
            except ValueError:
                continue  # a colour in another notation, which few programs write
            material.colour = numbers if len(numbers) == 3 else numbers[:1] * 3 or None


def _texture_name(rest: str) -> str:
    """The name of the file at the end of a line, after the options."""
    while option := _OPTION.match(rest):
        rest = rest[option.end():]
    return rest.strip().strip('"')
