"""The landmarks of an object: small places on its surface that can be told apart, each with a descriptor, as they are
seen from all around."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import fibonacci_sphere

FORM = 3  # of the landmarks in a bank; those of another are made again
DESCRIPTOR = 64  # numbers of a descriptor
MOST = 8_000  # landmarks of an object
SIDES = 60  # from which an object is seen
STEP = 0.05  # of the numbers of a descriptor, as they are kept: one of 16 in half a byte


@dataclass(frozen=True)
class Landmarks:
    """N landmarks, those first that are found again most often, from all sides in turn.

    points_m [N, 3] are their places in the object's frame, codes [N, 64] uint8 the numbers of their descriptors in 16
    steps, seen [SIDES, N] whether one is seen from a side, the directions of `fibonacci_sphere(SIDES)`. `usual` is how
    many are found again in a small, noisy picture of the object: few of a plain one.
    """

    points_m: NDArray[np.float32]
    codes: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    usual: float = 0.0

    @property
    def directions(self) -> NDArray[np.float64]:
        """The directions [SIDES, 3] from the object's centre to the cameras, in the object's frame."""
        return fibonacci_sphere(SIDES)

    @property
    def descriptors(self) -> NDArray[np.float32]:
        """The descriptors [N, 64], unit vectors."""
        rough = (self.codes.astype(np.float32) - 7.5) * STEP
        return rough / np.maximum(np.linalg.norm(rough, axis=1, keepdims=True), 1e-6)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What is kept in a file."""
        return {"landmark_points_m": self.points_m.astype(np.float16),
                "landmark_codes": self.codes[:, ::2] << 4 | self.codes[:, 1::2],
                "landmark_seen": np.packbits(self.seen, axis=0),
                "landmarks_usual": np.array([self.usual], dtype=np.float32)}


def landmarks_of(arrays: Mapping[str, NDArray[Any]]) -> Landmarks:
    """Landmarks from what was kept in a file. Raises ValueError if the arrays do not belong together, and KeyError if
    one is missing."""
    points, halves = arrays["landmark_points_m"], arrays["landmark_codes"]
    seen, usual = arrays["landmark_seen"], arrays["landmarks_usual"]
    count = len(points) if points.ndim == 2 else -1
    if not 0 <= count <= MOST or points.shape != (count, 3) or not np.isfinite(points).all():
        raise ValueError("its landmarks have no places")
    if halves.shape != (count, DESCRIPTOR // 2) or halves.dtype != np.uint8 or seen.dtype != np.uint8 \
            or seen.shape != ((SIDES + 7) // 8, count) or usual.shape != (1,) or not 0.0 <= float(usual[0]) < np.inf:
        raise ValueError("its landmarks do not fit their places")
    codes = np.stack([halves >> 4, halves & 15], axis=2).reshape(count, DESCRIPTOR)
    sides = np.unpackbits(seen, axis=0, count=SIDES).astype(bool)
    return Landmarks(points.astype(np.float32), codes, sides, float(usual[0]))


def coded(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The codes [N, 64] of unit vectors."""
    return np.clip(np.floor(descriptors / STEP) + 8, 0, 15).astype(np.uint8)
