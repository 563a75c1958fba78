"""Where an object ends below and above.

Outlines leave open what no view looks along: the hull of a box that is seen from above goes down to a point. Of all
shapes with the same outlines, that of the least height is taken: the hull is cut by the highest plane below and the
lowest plane above that leave all outlines covered. For what stands on a flat bottom or ends in a flat top, this is
right wherever the bottom's or the top's edge is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from saccade.app.objects.views.view import View, directions_of
from saccade.shared.world.geometry import Array, pixel_rays

SMOOTH = 0.7  # of the distances, in points of the grid
SIDE_RAD = np.radians(65)  # views from higher or lower do not tell a height
SHARE = 0.25  # chosen: of the views may ask for a higher shape: what only some see may be their error
RING_PX = (1.0, 2.5)  # within the outline are the pixels whose rays are followed
RAYS = 300  # of a view


@dataclass(frozen=True)
class Grid:
    """Points of a grid [X, Y, Z] with the distance `pitch_m` from `low_m` [3] on, and how far each is inside (m)."""

    low_m: Array
    pitch_m: float
    inside_m: NDArray[np.float32]

    @property
    def points_m(self) -> Array:
        """The points [X * Y * Z, 3]."""
        return self.low_m + self.pitch_m * np.stack(np.indices(self.inside_m.shape), -1).reshape(-1, 3)


def cut_in_height(grid: Grid, views: list[View], center: Array) -> Grid:
    """A grid with smooth distances, cut below and above."""
    sines = directions_of(views, center)[:, 2]
    inside = gaussian_filter(grid.inside_m, SMOOTH)
    found = [_ends(grid, view, float(np.arcsin(sine)), center)
             for view, sine in zip(views, sines, strict=True) if abs(sine) < np.sin(SIDE_RAD)]
    ends = np.array([each for each in found if each is not None])
    if len(ends):
        low, high = np.quantile(ends[:, 0], SHARE), np.quantile(ends[:, 1], 1 - SHARE)
        heights = grid.low_m[2] + grid.pitch_m * np.arange(grid.inside_m.shape[2])
        if high - low > 2 * grid.pitch_m:
            inside = np.minimum(inside, np.minimum(heights - low, high - heights).astype(np.float32))
    return replace(grid, inside_m=inside)


def _ends(grid: Grid, view: View, elevation_rad: float, center: Array) -> tuple[float, float] | None:
    """The highest lower end and the lowest upper end that leave the outline of a view covered (metres). None if it shows
    nothing of the hull.

    The ray of a pixel within the outline goes through the hull from one height to another, and one of them must remain.
    """
    within_px = distance_transform_edt(np.pad(view.mask, 1))[1:-1, 1:-1] - 0.5
    rows, columns = np.nonzero((within_px >= RING_PX[0]) & (within_px <= RING_PX[1]))
    some = np.linspace(0, len(rows) - 1, min(RAYS, len(rows))).astype(int)
    pixels = np.stack([columns[some], rows[some]], axis=-1) + 0.5
    rays = pixel_rays(pixels, view.intrinsics_px) @ view.world_from_camera[:3, :3].T
    away = float(np.linalg.norm(view.position_m - center))
    radius = float(np.linalg.norm(grid.inside_m.shape)) * grid.pitch_m / 2
    ranges = np.arange(max(away - radius, 0.0), away + radius, grid.pitch_m / 2)
    points = view.position_m + ranges[None, :, None] * rays[:, None]  # [N, R, 3]
    inside = map_coordinates(grid.inside_m, np.moveaxis((points - grid.low_m) / grid.pitch_m, -1, 0), order=1,
                             mode="constant", cval=-grid.pitch_m) > 0
    met = inside.any(1)
    if not met.any():
        return None
    heights = points[..., 2]
    lost_m = within_px[rows[some], columns[some]] * away / view.intrinsics_px[0] / np.cos(elevation_rad)
    lowest = np.where(inside, heights, -np.inf).max(1) - lost_m
    highest = np.where(inside, heights, np.inf).min(1) + lost_m
    return float(lowest[met].min()), float(highest[met].max())
