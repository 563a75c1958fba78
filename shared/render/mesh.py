"""Textured triangle meshes, and how they are read from scans: Wavefront OBJ files with a PNG or JPEG texture."""

from __future__ import annotations

import io
import os
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, opened
from saccade.shared.world.images import opened_image
from saccade.shared.world.symmetry import NONE

MESH_FILE = "textured.obj"
MAX_FILE_BYTES = 64 * MIB
MAX_COUNT = 1_000_000  # of faces, of vertices and of texture coordinates: a scan has some ten thousand
MAX_COORDINATE = 1e4
FLAT = 1e-6  # a mesh whose vertices are so close to one plane, relative to its size, has no volume

TEXTURE_MAX_PX = 2048  # with a larger texture a texel would be far smaller than a pixel, even in the nearest view


@dataclass(frozen=True)
class Mesh:
    """A textured triangle mesh. The centre of its box is at the origin.

    It has vertices_m [V, 3], texture coordinates [V, 2] (v points up), faces [F, 3] and a texture [H, W, 3] uint8. Its
    `symmetry` is that about its up axis (`shared/world/symmetry.py`).
    """

    name: str
    vertices_m: NDArray[np.float32]
    texcoords: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]
    symmetry: int = NONE

    @property
    def size_m(self) -> NDArray[np.float64]:
        """Extents [3] of the axis-aligned box, metres."""
        return np.asarray(self.vertices_m.max(0) - self.vertices_m.min(0), dtype=np.float64)


def read_obj(folder: Path, name: str) -> Mesh:
    """Reads `textured.obj` and `texture_map.jpg` or `.png` from a folder.

    Raises SaccadeError, with the path and what to do, if a file is missing or damaged.
    """
    path = folder / MESH_FILE
    if not os.path.isfile(path):
        raise SaccadeError(f"mesh {path} is missing: set SACCADE_YCB to a folder with {name}/textured.obj in it")
    try:
        with opened(path, "mesh", "fetch it again", MAX_FILE_BYTES) as stream:
            vertices, texcoords, faces = _parse_obj(io.TextIOWrapper(stream, encoding="utf-8"))
    except (ValueError, OverflowError) as error:
        raise SaccadeError(f"mesh {path} is damaged ({error}): fetch it again") from error
    vertices -= (vertices.max(0) + vertices.min(0)) / 2
    return Mesh(name, vertices, texcoords, faces, read_texture(folder))


def _parse_obj(lines: Iterable[str]) -> tuple[NDArray, NDArray, NDArray]:
    """Parses triangles with texture coordinates from the lines of a Wavefront OBJ file.

    Returns vertices [V, 3], texture coordinates [V, 2] and faces [F, 3], with one output vertex for each distinct pair
    of a vertex and a texture coordinate. Raises ValueError or IndexError if the file is damaged.
    """
    numbers, texels, indices = array("d"), array("d"), array("q")
    for line in lines:
        if line.startswith("v "):
            numbers.extend(_exactly(3, [float(word) for word in line.split(None, 4)[1:4]]))
        elif line.startswith("vt "):
            texels.extend(_exactly(2, [float(word) for word in line.split(None, 3)[1:3]]))
        elif line.startswith("f "):
            words = _exactly(3, line.split(None, 4)[1:])
            indices.extend(_index(text) for word in words for text in _exactly(2, word.split("/", 2)[:2]))
        if len(numbers) > 3 * MAX_COUNT or len(texels) > 2 * MAX_COUNT or len(indices) > 6 * MAX_COUNT:
            raise ValueError(f"it has more than {MAX_COUNT} vertices or faces")
    positions, coords = np.array(numbers).reshape(-1, 3), np.array(texels).reshape(-1, 2)
    corners = np.array(indices).reshape(-1, 3, 2)
    if len(corners) == 0 or len(positions) == 0:
        raise ValueError("no textured triangles in it")
    if corners.min() < 1 or corners[..., 0].max() > len(positions) or corners[..., 1].max() > len(coords):
        raise ValueError("a face refers to a vertex that is not there")
    corners -= 1  # they count from 1
    if not (np.isfinite(positions).all() and np.isfinite(coords).all()):
        raise ValueError("a coordinate is not finite")
    if max(np.abs(positions).max(), np.abs(coords).max()) > MAX_COORDINATE:
        raise ValueError(f"a coordinate is beyond {MAX_COORDINATE:g}")
    positions, coords = positions.astype(np.float32), coords.astype(np.float32)
    pairs, inverse = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    used = positions[pairs[:, 0]]
    if np.linalg.matrix_rank(used - used.mean(0), tol=FLAT * np.ptp(used, axis=0).max() * len(used) ** 0.5) < 3:
        raise ValueError("its vertices lie in one plane, and an object has a volume")
    return used, coords[pairs[:, 1]], inverse.reshape(-1, 3).astype(np.int32)


def _index(text: str) -> int:
    """The number of a vertex. A number that no file reaches becomes one that is not there."""
    return int(text) if len(text) <= 18 else 2 * MAX_COUNT


def _exactly(count: int, words: list) -> list:
    if len(words) != count:
        raise ValueError("no textured triangles in it")
    return words


def read_texture(folder: Path) -> NDArray[np.uint8]:
    """Reads the PNG or JPEG texture [H, W, 3] of a mesh. It is reduced to at most TEXTURE_MAX_PX in width and height.

    Raises SaccadeError if it is missing or damaged.
    """
    for path in (folder / "texture_map.png", folder / "texture_map.jpg", folder / "texture_map.jpeg"):
        if os.path.isfile(path):
            try:
                with opened_image(path, "texture", "fetch it again") as opened_texture:
                    image = opened_texture.convert("RGB")
            except SaccadeError as error:
                if error.__cause__ is None:
                    raise
                raise SaccadeError(f"texture {path} is damaged ({error.__cause__}): fetch it again") from error
            image.thumbnail((TEXTURE_MAX_PX, TEXTURE_MAX_PX), Image.Resampling.BOX)
            return np.asarray(image)
    raise SaccadeError(f"texture {folder / 'texture_map.png'} (or .jpg) is missing: fetch the object again")
