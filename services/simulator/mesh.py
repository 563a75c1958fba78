"""Textured triangle meshes, and how they are read from scans: Wavefront OBJ files with a PNG or JPEG texture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from saccade.shared.errors import SaccadeError

TEXTURE_MAX_PX = 2048  # with a larger texture a texel would be far smaller than a pixel, even in the nearest view


@dataclass(frozen=True)
class Mesh:
    """A textured triangle mesh. The centre of its box is at the origin.

    It has vertices_m [V, 3], texture coordinates [V, 2] (v points up), faces [F, 3] and a texture [H, W, 3] uint8.
    """

    name: str
    vertices_m: NDArray[np.float32]
    texcoords: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]

    @property
    def size_m(self) -> NDArray[np.float64]:
        """Extents [3] of the axis-aligned box, metres."""
        return np.asarray(self.vertices_m.max(0) - self.vertices_m.min(0), dtype=np.float64)


def read_obj(folder: Path, name: str) -> Mesh:
    """Reads `textured.obj` and `texture_map.jpg` or `.png` from a folder.

    Raises SaccadeError, with the path and what to do, if a file is missing or damaged.
    """
    path = folder / "textured.obj"
    if not path.is_file():
        raise SaccadeError(f"mesh {path} is missing: set SACCADE_YCB to a folder with {name}/textured.obj in it")
    try:
        vertices, texcoords, faces = _parse_obj(path.read_text().splitlines())
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise SaccadeError(f"mesh {path} is damaged ({error}): fetch it again") from error
    vertices -= (vertices.max(0) + vertices.min(0)) / 2
    return Mesh(name, vertices, texcoords, faces, read_texture(folder))


def _parse_obj(lines: list[str]) -> tuple[NDArray, NDArray, NDArray]:
    """Parses triangles with texture coordinates from the lines of a Wavefront OBJ file.

    Returns vertices [V, 3], texture coordinates [V, 2] and faces [F, 3], with one output vertex for each distinct pair
    of a vertex and a texture coordinate. Raises ValueError or IndexError if the file is damaged.
    """
    positions = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float32)
    coords = np.array([line.split()[1:3] for line in lines if line.startswith("vt ")], dtype=np.float32)
    corners = np.array([[c.split("/")[:2] for c in line.split()[1:]] for line in lines if line.startswith("f ")],
                       dtype=np.int64) - 1
    if corners.ndim != 3 or corners.shape[1:] != (3, 2) or len(positions) == 0:
        raise ValueError("no textured triangles in it")
    if corners.min() < 0 or corners[..., 0].max() >= len(positions) or corners[..., 1].max() >= len(coords):
        raise ValueError("a face refers to a vertex that is not there")
    if not (np.isfinite(positions).all() and np.isfinite(coords).all()):
        raise ValueError("a coordinate is not finite")
    pairs, inverse = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    return positions[pairs[:, 0]], coords[pairs[:, 1]], inverse.reshape(-1, 3).astype(np.int32)


def read_texture(folder: Path) -> NDArray[np.uint8]:
    """Reads the PNG or JPEG texture [H, W, 3] of a mesh. It is reduced to at most TEXTURE_MAX_PX in width and height.

    Raises SaccadeError if it is missing or damaged.
    """
    for path in (folder / "texture_map.png", folder / "texture_map.jpg", folder / "texture_map.jpeg"):
        if path.is_file():
            try:
                image = Image.open(path).convert("RGB")
            except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
                raise SaccadeError(f"texture {path} is damaged ({error}): fetch it again") from error
            image.thumbnail((TEXTURE_MAX_PX, TEXTURE_MAX_PX), Image.Resampling.BOX)
            return np.asarray(image)
    raise SaccadeError(f"texture {folder / 'texture_map.png'} (or .jpg) is missing: fetch the object again")
