"""How much of an object a camera sees, by the boxes around the objects: without rendering, so that it is the same
everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, Array, project
from saccade.shared.world.workspace import Boxes

IN_VIEW = 0.3  # an object is in view if at least this share of it is seen
_SHARES = np.array([-0.8, 0.0, 0.8])  # of half the box, along each axis
_GRID = np.stack(np.meshgrid(_SHARES, _SHARES, _SHARES, indexing="ij"), axis=-1).reshape(-1, 3)
_SHRUNK = 0.85  # boxes that hide others are so much smaller, because an object does not fill its box


def seen_shares(world_from_camera: ArrayLike, objects: Boxes, others: Boxes,
                intrinsics_px: ArrayLike = INTRINSICS_PX, size_px: int = IMAGE_SIZE_PX) -> Array:
    """The share of each object [N], from 0 to 1, that is in the image of a camera pose [4, 4] and not hidden.

    It is counted in 27 points of each object's box. Objects hide each other, and the boxes `others` hide them too.
    """
    if not len(objects):
        return np.zeros(0)
    camera = np.asarray(world_from_camera, dtype=np.float64)
    points = objects.centers_m[:, None] + np.einsum(
        "nij,npj->npi", objects.rotations, _GRID * objects.sizes_m[:, None] / 2)
    pixels, depths = project(points, camera, intrinsics_px)
    seen = (depths > 0) & ((pixels >= 0) & (pixels < size_px)).all(-1)
    smaller = Boxes(objects.centers_m, objects.rotations, _SHRUNK * objects.sizes_m)
    starts = np.broadcast_to(camera[:3, 3], points.shape)
    hidden = smaller.crossed(starts, points)
    hidden &= ~np.eye(len(objects), dtype=bool)[:, None]  # what an object hides of itself is seen from elsewhere
    blocked = others.crossed(starts, points).any(-1) if len(others) else np.zeros(points.shape[:-1], dtype=bool)
    return np.asarray((seen & ~hidden.any(-1) & ~blocked).mean(1))
