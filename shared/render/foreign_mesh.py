"""Reads meshes as people have them: OBJ, GLB, glTF, PLY and STL, in any unit, with either axis up, with any number of
parts, textures and colours. What is guessed or changed is said in notes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError, is_text, told
from saccade.shared.render.mesh import FLAT, Mesh
from saccade.shared.render.mesh_atlas import baked
from saccade.shared.render.mesh_library import read_with_library
from saccade.shared.render.mesh_parts import EXPORT_AGAIN, MAX_FACES, TOO_MANY, Folder, Loaded, Part, open_edges, weld
from saccade.shared.render.mesh_thin import MANY_FACES, thinned
from saccade.shared.render.mesh_units import METRES, choose_unit, choose_up
from saccade.shared.render.mesh_wavefront import read_wavefront

READERS = {".obj": read_wavefront, ".glb": read_with_library, ".gltf": read_with_library, ".ply": read_with_library,
           ".stl": read_with_library}
KINDS = "OBJ, GLB, glTF, PLY or STL"
MAX_NAME = 256
MAX_FILES = 64  # of a folder
_Z_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Imported:
    """A mesh from a file, and sentences that say what was guessed or changed."""

    mesh: Mesh
    notes: tuple[str, ...]
    unit: Literal["m", "cm", "mm"]  # of the file
    up: str  # the file's axis that points up
    files: tuple[Path, ...]  # the mesh files that were read


def read_mesh(path: Path, name: str, *, unit: Literal["m", "cm", "mm", "auto"] = "auto",
              up: Literal["z", "y", "auto"] = "auto") -> Imported:
    """Reads a mesh file, or all mesh files of a folder as the parts of one object.

    The mesh is in metres with z up, and has one texture. Raises SaccadeError, in one line that says what to do, if the
    file is missing, damaged, or no object that can stand on a table.
    """
    if not name.strip() or len(name) > MAX_NAME or not is_text(name) or "/" in name or "\\" in name:
        raise SaccadeError(f"{told(name)} cannot be the name of an object: give a name of 1 to {MAX_NAME} characters, "
                           "without / and control codes")
    files = _files(path)
    loaded = _joined([READERS[file.suffix.lower()](file, Folder(file.parent, file)) for file in files], path)
    parts = _usable(loaded.parts, path)
    notes = list(loaded.notes)
    if len(files) > 1:
        notes.insert(0, f"The object is made of all meshes in the folder: {', '.join(file.name for file in files)}.")
    corners = np.concatenate([part.corners for part in parts])
    axis, up_note = choose_up(corners, up, loaded)
    chosen, unit_note = choose_unit(float(np.ptp(corners.reshape(-1, 3), axis=0).max()), unit, loaded, str(path))
    notes += [unit_note, up_note, *_closed_note(corners)]
    if len(corners) > MANY_FACES:
        parts = _without_flat(thinned(parts), path)
        remain = sum(len(part.corners) for part in parts)
        notes.append(f"The mesh was simplified from {len(corners)} to {remain} faces, so that it is rendered fast.")
    mesh = joined_mesh(parts, name, METRES[chosen], axis, path)
    return Imported(mesh, tuple(dict.fromkeys(notes)), chosen, axis, files)


def _files(path: Path) -> tuple[Path, ...]:
    """The mesh file, or those of a folder. Raises SaccadeError if there is none."""
    try:
        is_folder, is_there = os.path.isdir(path), os.path.exists(path)
        found = sorted(file for file in path.iterdir() if file.suffix.lower() in READERS) if is_folder else [path]
    except (OSError, ValueError) as error:
        raise SaccadeError(f"mesh {path} cannot be read ({getattr(error, 'strerror', None) or error}): give a file of "
                           f"the kind {KINDS}") from error
    if not is_there and "\0" not in str(path):
        raise SaccadeError(f"mesh {path} is missing: give the path of a file of the kind {KINDS}")
    if is_folder and not 0 < len(found) <= MAX_FILES:
        raise SaccadeError(f"folder {path} holds {len(found) or 'no'} meshes: give the path of one file of the kind "
                           f"{KINDS}, or a folder with at most {MAX_FILES}, the parts of one object")
    if found[0].suffix.lower() not in READERS:
        raise SaccadeError(f"mesh {path} is of an unknown kind: export it as {KINDS}")
    return tuple(found)


def _joined(loaded: list[Loaded], path: Path) -> Loaded:
    """Several files as one. They must be of one kind, because each kind has its own unit and axes."""
    kinds = sorted({one.kind for one in loaded})
    if len(kinds) > 1:
        raise SaccadeError(f"folder {path} holds meshes of several kinds ({', '.join(kinds)}): give the path of one "
                           "file, or leave one kind in the folder")
    first = loaded[0]
    return Loaded([part for one in loaded for part in one.parts], [note for one in loaded for note in one.notes],
                  first.kind, first.unit, first.up, first.likely_up)


def _usable(parts: list[Part], path: Path) -> list[Part]:
    """The parts without faces that have no area. Raises SaccadeError if that is no object."""
    if sum(len(part.corners) for part in parts) > MAX_FACES:
        raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    for part in parts:
        if not np.isfinite(part.corners).all() or (part.uv is not None and not np.isfinite(part.uv).all()):
            raise SaccadeError(f"mesh {path} is damaged (a coordinate is not finite): {EXPORT_AGAIN}")
        if np.abs(part.corners).max(initial=0.0) > 1e9 or (part.uv is not None
                                                          and np.abs(part.uv).max(initial=0.0) > 1e6):
            raise SaccadeError(f"mesh {path} is damaged (a coordinate is too large): {EXPORT_AGAIN}")
    parts = _without_flat(parts, path)
    corners = np.concatenate([part.corners for part in parts]).reshape(-1, 3)
    points, _ = weld(corners - corners.min(0))
    middle = points.astype(np.float64) - points.mean(0)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(middle.T @ middle / len(points)), 0.0))
    if spread[0] <= FLAT * np.ptp(middle, axis=0).max():
        raise SaccadeError(f"mesh {path} lies in one plane, and an object has a volume: give it a thickness in a mesh "
                           "program")
    return parts


def _without_flat(parts: list[Part], path: Path) -> list[Part]:
    """The parts without faces that have no area. Raises SaccadeError if no face remains."""
    kept = []
    for part in parts:
        sides = part.corners[:, 1:] - part.corners[:, :1]
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        longest = (sides ** 2).sum(2).max(1, initial=0.0)
        kept.append(part.chosen(area > 1e-9 * np.maximum(longest, 1e-300)))
    kept = [part for part in kept if len(part.corners)]
    if not kept:
        raise SaccadeError(f"mesh {path} has no faces: {EXPORT_AGAIN}, with faces")
    return kept


def _closed_note(corners: NDArray[np.float64]) -> list[str]:
    count = open_edges(corners)
    return [f"The mesh is not closed ({count} of its edges have a face on one side only): where it is open, the camera "
            "sees through it."] if count else []


def joined_mesh(parts: list[Part], name: str, metres: float, axis: str, path: Path) -> Mesh:
    """Parts whose unit has this length, with this axis up, as one mesh. Raises SaccadeError, which names the path, if
    they have too many textures and colours."""
    corners = np.concatenate([part.corners for part in parts])
    if axis == "y":
        corners = corners @ _Z_FROM_Y_UP.T
    low, high = corners.min((0, 1)), corners.max((0, 1))
    corners = (corners - (low + high) / 2) * metres
    try:
        uv, texture = baked(parts)
    except ValueError as error:
        raise SaccadeError(f"mesh {path} cannot be used ({error}): simplify its materials in a mesh program") from error
    rows, inverse = weld(np.concatenate([corners, uv], axis=-1).reshape(-1, 5))
    return Mesh(name, np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:]),
                inverse.reshape(-1, 3).astype(np.int32), np.ascontiguousarray(texture))
