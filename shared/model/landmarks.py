"""The landmarks of an object: small places on its surface that can be told apart, each with a descriptor, as they are
seen from all around."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import fibonacci_sphere

DESCRIPTOR = 64  # numbers of a descriptor
PER_VIEW = 80  # places in each view: the surest ones
VIEWS = 60
MAX_VIEWS = 1_000
STEP = 1 / 127  # of the numbers of a descriptor, as they are kept


@dataclass(frozen=True)
class Landmarks:
    """What local features find in V views of an object, seen from `fibonacci_sphere(V)`, up to K in each.

    points_m [V, K, 3] are their places in the object's frame, descriptors [V, K, 64] int8 their unit vectors in steps
    of 1/127, counts [V] how many of the K there are; the rest is zero. `usual` is how many are found again in a small,
    noisy picture of the object: few of a plain one.
    """

    points_m: NDArray[np.float32]
    descriptors: NDArray[np.int8]
    counts: NDArray[np.uint8]
    usual: float = 0.0

    @property
    def directions(self) -> NDArray[np.float64]:
        """The directions [V, 3] from the object's centre to the cameras, in the object's frame."""
        return fibonacci_sphere(len(self.counts))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What is kept in a file: the landmarks that there are, one view after the other."""
        there = np.arange(self.points_m.shape[1]) < self.counts[:, None]
        return {"landmark_points_m": self.points_m[there].astype(np.float16),
                "landmark_descriptors": self.descriptors[there], "landmark_counts": self.counts,
                "landmarks_usual": np.array([self.usual], dtype=np.float32)}


def landmarks_of(arrays: Mapping[str, NDArray[Any]]) -> Landmarks:
    """Landmarks from what was kept in a file. Raises ValueError if the arrays do not belong together, and KeyError if
    one is missing."""
    points, descriptors = arrays["landmark_points_m"], arrays["landmark_descriptors"]
    counts, usual = arrays["landmark_counts"], arrays["landmarks_usual"]
    if counts.dtype != np.uint8 or counts.ndim != 1 or not 0 < len(counts) <= MAX_VIEWS:
        raise ValueError("its landmarks have no views")
    total = int(counts.astype(np.int64).sum())
    if points.shape != (total, 3) or descriptors.shape != (total, DESCRIPTOR) or descriptors.dtype != np.int8 \
            or not np.isfinite(points).all() or usual.shape != (1,) or not 0.0 <= float(usual[0]) < np.inf:
        raise ValueError("its landmarks do not fit their views")
    most = max(1, int(counts.max()))
    there = np.arange(most) < counts[:, None]
    all_points = np.zeros((len(counts), most, 3), dtype=np.float32)
    all_descriptors = np.zeros((len(counts), most, DESCRIPTOR), dtype=np.int8)
    all_points[there], all_descriptors[there] = points, descriptors
    return Landmarks(all_points, all_descriptors, counts, float(usual[0]))


def packed(views: list[tuple[NDArray[np.float64], NDArray[np.float32]]]) -> Landmarks:
    """Landmarks from the places [N, 3] (m) and the unit descriptors [N, 64] in each view, the surest first."""
    most = max(1, min(PER_VIEW, max(len(places) for places, _ in views)))
    points = np.zeros((len(views), most, 3), dtype=np.float32)
    descriptors = np.zeros((len(views), most, DESCRIPTOR), dtype=np.int8)
    counts = np.zeros(len(views), dtype=np.uint8)
    for view, (places, vectors) in enumerate(views):
        counts[view] = count = min(most, len(places))
        points[view, :count] = places[:count]
        descriptors[view, :count] = np.round(vectors[:count] / STEP)
    return Landmarks(points, descriptors, counts)
