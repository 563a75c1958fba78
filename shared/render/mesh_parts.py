"""The parts of a mesh from a file, before they become one mesh: triangles with a texture or with colours each."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import read_bytes
from saccade.shared.render.mesh import MAX_FILE_BYTES, TEXTURE_MAX_PX
from saccade.shared.world.images import MAX_PIXELS

MAX_FACES = 1_000_000
MAX_IMAGES = 64
GREY = (160, 160, 160)  # of what has no colour
EXPORT_AGAIN = "export it again from the program that made it"
TOO_MANY = f"it has more than {MAX_FACES} faces: reduce it with a mesh program, such as the decimation of Blender"
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")

Unit = Literal["m", "cm", "mm"]
Axis = Literal["y", "z"]


@dataclass(frozen=True)
class Part:
    """Triangles with corners [F, 3, 3] in the file's unit.

    It has either an image in RGB with texture coordinates uv [F, 3, 2] (v points up), or colours [F, 3, 3] uint8 of the
    corners.
    """

    corners: NDArray[np.float64]
    uv: NDArray[np.float64] | None = None
    image: Image.Image | None = None
    colours: NDArray[np.uint8] | None = None

    def chosen(self, faces: NDArray) -> Part:
        """The part with only these faces: a mask [F] or numbers."""
        return Part(self.corners[faces], None if self.uv is None else self.uv[faces], self.image,
                    None if self.colours is None else self.colours[faces])


@dataclass(frozen=True)
class Loaded:
    """What a file holds: its parts, and what it or its kind says of units and axes."""

    parts: list[Part]
    notes: list[str]
    kind: str
    unit: tuple[Unit, str] | None = None  # with the reason
    up: tuple[Axis, str] | None = None  # with the reason
    likely_up: Axis = "z"  # if neither the file nor the shape tells


def coloured(corners: NDArray[np.float64], colour: tuple[int, ...] | NDArray) -> Part:
    """A part of one colour, or of colours [F, 1 or 3, 3]."""
    return Part(corners, colours=np.broadcast_to(np.asarray(colour, dtype=np.uint8), corners.shape))


def weld(rows: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The different rows of [N, K], in single precision, and the number of each row among them [N]."""
    single = np.ascontiguousarray(rows, dtype=np.float32) + np.float32(0.0)  # -0.0 becomes 0.0
    keys = single.view(np.dtype((np.void, single.itemsize * single.shape[1]))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return single[first], inverse.ravel()


def open_edges(corners: NDArray[np.float64]) -> int:
    """How many edges of triangles [F, 3, 3] do not join two of them. A closed surface has none."""
    _, inverse = weld(corners.reshape(-1, 3))
    faces = inverse.reshape(-1, 3)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges[:, 0] * (inverse.max() + 1) + edges[:, 1], return_counts=True)
    return int((counts % 2).sum())


@dataclass
class Folder:
    """The folder of a mesh file. Only files inside it are read, and only a limited number of bytes of all together."""

    path: Path
    mesh: Path
    left: int = 2 * MAX_FILE_BYTES
    images: dict[Path, Image.Image] = field(default_factory=dict)
    seen: dict[Path, bytes] = field(default_factory=dict)

    def find(self, named: str) -> Path | None:
        """The file that a mesh names, or one of the same name beside the mesh. None if it is not there."""
        name = PurePosixPath(named.replace("\\", "/"))
        for inside in (name, PurePosixPath(name.name)):
            path = self.path / inside
            try:
                if name.name and path.resolve().is_relative_to(self.path.resolve()) and os.path.isfile(path):
                    return path
            except (OSError, ValueError, RuntimeError):  # a path that no file can have, or links in a circle
                continue
        return None

    def read(self, named: str, what: str) -> bytes:
        """The bytes of a file that the mesh names. Raises SaccadeError if it is missing or too large."""
        path = self.find(named)
        if path is None:
            name = PurePosixPath(named.replace("\\", "/")).name
            raise SaccadeError(f"{what} {told(named)} is missing, which mesh {self.mesh} names: put it there as "
                               f"{self.path / name}")
        if path not in self.seen:
            self.seen[path] = read_bytes(path, what, f"make it smaller, or take it out of {self.mesh}", self.left)
            self.left -= len(self.seen[path])
        return self.seen[path]

    def image(self, named: str) -> Image.Image:
        """The texture that the mesh names, in RGB. Raises SaccadeError if it is missing or damaged."""
        data = self.read(named, "texture")
        path = self.find(named) or self.path
        if path not in self.images:
            if len(self.images) == MAX_IMAGES:
                raise SaccadeError(f"mesh {self.mesh} names more than {MAX_IMAGES} textures: join them in a mesh "
                                   "program")
            self.images[path] = decoded(lambda: Image.open(io.BytesIO(data), formats=_FORMATS), str(path))
        return self.images[path]


def decoded(opening: Callable[[], Image.Image], where: str) -> Image.Image:
    """An image in RGB of at most TEXTURE_MAX_PX in width and height. Raises SaccadeError, which says where it is, if it
    is damaged, of another kind or too large."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = opening()
            if image.format not in (None, *_FORMATS):
                raise ValueError(f"it is a {image.format}")
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"it has {image.width}x{image.height} pixels, more than {MAX_PIXELS}")
            image = image.convert("RGB")
            image.thumbnail((TEXTURE_MAX_PX, TEXTURE_MAX_PX), Image.Resampling.BOX)
            return image
        except Exception as error:  # Pillow raises many kinds for images that are damaged or made to harm
            why = str(error) or type(error).__name__
            raise SaccadeError(f"texture {where} is damaged ({why}): replace it with a whole PNG or JPEG") from error
