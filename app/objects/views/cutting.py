"""Cuts what outlines leave open.

The hull of a box that is seen from above goes down to a point, and its sides bulge where no view looks along them. Of
all shapes with the same outlines the least is the likelier one. So in each of many directions the hull is cut by the
nearest plane that leaves all outlines covered. For a flat side this is right wherever its edges are seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, maximum_filter

from saccade.app.objects.views.view import View
from saccade.shared.world.geometry import Array, direction, fibonacci_sphere, pixel_rays, unit

SMOOTH = 0.7  # of the distances, in points of the grid
LEVEL, OTHERS = 240, 300  # directions of the planes: level, in which most objects have flat sides, and all around
ACROSS = np.cos(np.radians(65))  # views that look more along a direction do not tell where the object ends in it
RING = (1.0, 2.2)  # within the outline are the pixels whose rays are followed, in points of the grid
RAYS = 400  # of a view
TOGETHER = 30  # planes


@dataclass(frozen=True)
class Grid:
    """Points of a grid [X, Y, Z] with the distance `pitch_m` from `low_m` [3] on, and how far each is inside (m)."""

    low_m: Array
    pitch_m: float
    inside_m: NDArray[np.float32]

    @property
    def points_m(self) -> Array:
        """The points [X * Y * Z, 3]."""
        return self.low_m + self.pitch_m * np.moveaxis(np.indices(self.inside_m.shape), 0, -1).reshape(-1, 3)


def cut(grid: Grid, views: list[View]) -> Grid:
    """A grid with smooth distances, cut by planes all around."""
    around = direction(2 * np.pi / LEVEL * np.arange(LEVEL), 0.0)
    planes = np.concatenate([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], around, fibonacci_sphere(OTHERS)])
    ends = np.full(len(planes), -np.inf)
    for view in views:
        ends = np.maximum(ends, _ends(grid, view, planes))
    planes, ends = planes[np.isfinite(ends)], ends[np.isfinite(ends)]
    inside = gaussian_filter(grid.inside_m, SMOOTH).ravel()
    near = inside > -2 * grid.pitch_m
    points, least = grid.points_m[near], inside[near]
    for start in range(0, len(planes), TOGETHER):
        some = slice(start, start + TOGETHER)
        least = np.minimum(least, (ends[some] - points @ planes[some].T).min(1))
    inside[near] = least
    return replace(grid, inside_m=inside.reshape(grid.inside_m.shape))


def _ends(grid: Grid, view: View, planes: Array) -> Array:
    """How far the hull must reach in the directions of planes [P, 3] so that the outline of a view stays covered [P],
    in metres from the world's origin. It is -inf where the view does not tell it.

    The ray of a pixel within the outline enters the hull and leaves it, and one of these two places must remain.
    """
    size = np.array(grid.inside_m.shape) * grid.pitch_m
    center = grid.low_m + size / 2
    away, radius = float(np.linalg.norm(view.position_m - center)), float(np.linalg.norm(size)) / 2
    point_px = grid.pitch_m * view.intrinsics_px[0] / away
    within_px = distance_transform_edt(np.pad(view.mask, 1))[1:-1, 1:-1] - 0.5
    thin = (within_px < RING[0] * point_px) & (within_px == maximum_filter(within_px, 3)) & view.mask
    rows, columns = np.nonzero(((within_px >= RING[0] * point_px) & (within_px <= RING[1] * point_px)) | thin)
    if not len(rows):
        return np.full(len(planes), -np.inf)
    some = np.linspace(0, len(rows) - 1, min(RAYS, len(rows))).astype(int)
    pixels = np.stack([columns[some], rows[some]], axis=-1) + 0.5
    rays = pixel_rays(pixels, view.intrinsics_px) @ view.world_from_camera[:3, :3].T
    ranges = np.arange(max(away - radius, 0.0), away + radius, grid.pitch_m / 2)
    points = view.position_m + ranges[None, :, None] * rays[:, None]  # [N, R, 3]
    inside = map_coordinates(grid.inside_m, np.moveaxis((points - grid.low_m) / grid.pitch_m, -1, 0), order=1,
                             mode="constant", cval=-grid.pitch_m) > 0
    met = inside.any(1)
    if not met.any():
        return np.full(len(planes), -np.inf)
    points, inside, numbers = points[met], inside[met], np.arange(met.sum())
    enters, leaves = points[numbers, inside.argmax(1)], points[numbers, len(ranges) - 1 - inside[:, ::-1].argmax(1)]
    towards = unit(view.position_m - center)
    across = np.sqrt(np.maximum(1.0 - (planes @ towards) ** 2, 0.0))
    lost_m = (within_px[rows[some], columns[some]][met] * away / view.intrinsics_px[0])[:, None]
    reach = np.minimum(enters @ planes.T, leaves @ planes.T) + lost_m / np.maximum(across, ACROSS)
    return np.where(across > ACROSS, reach.max(0), -np.inf)
