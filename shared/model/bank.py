"""The bank of an object: what it looks like from all around, flat lit, each view with the direction it is seen from.

A bank is all that the networks which know no names need to know an object: q(p | o) is a distribution over its views,
moving the camera moves along it, and its views are what the agent expects to see.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError
from saccade.shared.model.landmarks import Landmarks, landmarks_of
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import fibonacci_sphere
from saccade.shared.world.windows import CROP_PX

FILLED = 0.92  # of the side of a crop or of a bank's view: the diameter of the circle around its object's outline
VIEWS = 300
QUALITY = 80  # of the compressed pictures
MAX_VIEWS = 5_000


@dataclass(frozen=True)
class Bank:
    """V views of an object. directions [V, 3] point from the object's centre to the camera, in the object's frame.
    circles_m [V, 3] are the circles around its outline, in metres at its centre: where they are (right, down) from it,
    and their radii. vectors [V, D] are the views' encodings. The pictures are held compressed. The landmarks have views
    of their own."""

    name: str
    circles_m: NDArray[np.float64]
    vectors: NDArray[np.float32]
    pictures: tuple[bytes, ...]
    landmarks: Landmarks

    @property
    def directions(self) -> NDArray[np.float64]:
        """The directions [V, 3], spread evenly over the sphere."""
        return fibonacci_sphere(len(self.pictures))

    def image(self, view: int) -> NDArray[np.uint8]:
        """A view [64, 64, 4] uint8: RGB, premultiplied by the coverage, and the coverage."""
        return picture(self.pictures[view])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What is kept in a file."""
        lengths = np.array([len(picture) for picture in self.pictures], dtype=np.uint32)
        return {"circles_m": self.circles_m.astype(np.float32), "vectors": self.vectors.astype(np.float16),
                "pictures": np.frombuffer(b"".join(self.pictures), dtype=np.uint8), "lengths": lengths,
                **self.landmarks.arrays()}


def bank_of(name: str, arrays: Mapping[str, NDArray[Any]]) -> Bank:
    """A bank from what was kept in a file. Raises ValueError if the arrays do not belong together, and KeyError if one
    is missing."""
    lengths, joined = arrays["lengths"], arrays["pictures"]
    count = len(lengths)
    circles, vectors = arrays["circles_m"].astype(np.float64), arrays["vectors"].astype(np.float32)
    if not 0 < count <= MAX_VIEWS or lengths.ndim != 1 or lengths.dtype.kind != "u" or joined.dtype != np.uint8 \
            or joined.ndim != 1 or int(lengths.astype(np.uint64).sum()) != len(joined):
        raise ValueError("its pictures do not fit their lengths")
    if circles.shape != (count, 3) or vectors.ndim != 2 or len(vectors) != count \
            or not (np.isfinite(circles).all() and np.isfinite(vectors).all() and (circles[:, 2] > 0).all()):
        raise ValueError("its views are not as many as its pictures, or are no numbers")
    ends = np.cumsum(lengths.astype(np.int64))
    pictures = tuple(joined[end - length:end].tobytes() for end, length in zip(ends, lengths, strict=True))
    return Bank(name, circles, vectors, pictures, landmarks_of(arrays))


def bank_in(weights: Weights, name: str) -> Bank:
    """The bank of an object in weights. Raises SaccadeError if it is missing or damaged."""
    try:
        return bank_of(name, weights.bank(name))
    except (ValueError, KeyError) as error:
        raise SaccadeError(f"bank of {name} in {weights.folder} is damaged ({error}): make it again") from error


def picture(data: bytes) -> NDArray[np.uint8]:
    """A view [64, 64, 4] from its compressed picture, see `Bank.image`."""
    with Image.open(io.BytesIO(data)) as opened:
        image = np.asarray(opened.convert("RGBA"))
    # The compression leaves colours where nothing is covered.
    return np.concatenate([np.minimum(image[..., :3], image[..., 3:]), image[..., 3:]], axis=2)


def compressed(images: NDArray[np.uint8]) -> tuple[bytes, ...]:
    """Pictures [V, 64, 64, 4] as a bank keeps them."""
    if images.shape[1:] != (CROP_PX, CROP_PX, 4):
        raise ValueError(f"pictures of shape {images.shape}")
    pictures = []
    for image in images:
        file = io.BytesIO()
        Image.fromarray(image).save(file, "WEBP", quality=QUALITY, method=4)
        pictures.append(file.getvalue())
    return tuple(pictures)
