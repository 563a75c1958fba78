"""The shape of an object from its outlines: the visual hull, which is what lies within the outline in every view.

For each point of a grid, each view says how far it is inside its outline, in metres, and the least of these counts. So
the surface lies between the points of the grid, and not only at them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from saccade.app.objects.views.cutting import Grid, cut
from saccade.app.objects.views.view import View
from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh_thin import MANY_FACES, simplified
from saccade.shared.world.geometry import Array, pixel_rays, project

COARSE, FINE = 40, 104  # points along the longest side of the grid
WIDER = 1.25  # than the outlines, where the coarse grid begins
COVERED = 0.92  # of a view's outline: otherwise it is not that of the same object
AGREEING = 0.6  # of the views
NEEDS = ("making an object from pictures needs the libraries scikit-image and fast-simplification: pip install "
         "'saccade[objects]'")


@dataclass(frozen=True)
class Hull:
    """A closed surface: points_m [P, 3] and faces [F, 3], in the poses' world. `views` are those that agree on it."""

    points_m: Array
    faces: NDArray[np.int64]
    views: list[View]


def hull_of(views: list[View]) -> Hull:
    """The hull of an object. Raises SaccadeError if the outlines are not those of one object."""
    try:
        import fast_simplification  # noqa: F401  # which `simplified` needs
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise SaccadeError(NEEDS) from error
    distances = [_distances(view.mask) for view in views]
    center, radius = _ball(views)
    coarse = _empty(center - radius, np.full(3, 2 * radius), COARSE)
    agreeing = _agreeing(views, distances, coarse)
    if len(agreeing) < AGREEING * len(views):
        raise SaccadeError(f"the outlines of {len(views) - len(agreeing)} of {len(views)} pictures do not meet in one "
                           "object: look at the poses with `saccade poses show`, and see that the object did not move "
                           "and that the intrinsics are right")
    views, distances = [views[k] for k in agreeing], [distances[k] for k in agreeing]
    coarse = _carved(coarse, views, distances)
    there = coarse.points_m[(coarse.inside_m > -coarse.pitch_m).ravel()]
    low, high = there.min(0) - coarse.pitch_m, there.max(0) + coarse.pitch_m
    fine = _carved(_empty(low, high - low, FINE), views, distances)
    least = cut(fine, views)
    if least.inside_m.max() <= 0:
        raise SaccadeError("nothing is left of the object where all outlines meet: is it thinner than a hundredth of "
                           "its length, or do the poses not fit the pictures?")
    padded = np.pad(least.inside_m, 1, constant_values=-least.pitch_m)
    points, faces, *_ = marching_cubes(padded, 0.0, gradient_direction="ascent")
    points, faces = points.astype(np.float64), faces.astype(np.int64)
    if len(faces) > MANY_FACES:
        points, faces, _ = simplified(points, faces, MANY_FACES)
    return Hull(least.low_m + least.pitch_m * (points - 1), faces, views)


def _distances(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """How far each pixel is inside the outline [H + 2, W + 2], in pixels; outside it is less than zero."""
    padded = np.pad(mask, 1)
    inside, outside = distance_transform_edt(padded), distance_transform_edt(~padded)
    return np.where(padded, inside - 0.5, 0.5 - outside).astype(np.float32)


def _ball(views: list[View]) -> tuple[Array, float]:
    """The place [3] where the rays through the middles of the outlines come nearest to one another, and a radius (m)
    around it that covers the outlines."""
    rays, ends = [], []
    for view in views:
        middle = np.argwhere(view.mask).mean(0)[::-1] + 0.5
        rays.append(view.world_from_camera[:3, :3] @ pixel_rays(middle, view.intrinsics_px))
    across = np.eye(3) - np.einsum("ni,nj->nij", np.stack(rays), np.stack(rays))
    positions = np.stack([view.position_m for view in views])
    matrix, wanted = across.sum(0), np.einsum("nij,nj->i", across, positions)
    if np.linalg.cond(matrix) > 1e6:
        raise SaccadeError("all pictures look in the same direction: go around the object")
    center = np.linalg.solve(matrix, wanted)
    for view in views:
        pixel, depth = project(center, view.world_from_camera, view.intrinsics_px)
        rows, columns = np.nonzero(view.mask)
        far_px = max(np.abs(columns - pixel[0]).max(), np.abs(rows - pixel[1]).max())
        ends.append(max(float(depth), 0.0) * far_px / view.intrinsics_px[0])
    radius = WIDER * float(np.quantile(ends, 0.9))
    if not radius > 0:
        raise SaccadeError("the cameras look away from the place where the outlines would meet: look at the poses with "
                           "`saccade poses show`")
    return center, radius


def _empty(low: Array, size: Array, points: int) -> Grid:
    """A grid with so many points along its longest side."""
    pitch = float(size.max()) / (points - 1)
    shape = np.ceil(size / pitch).astype(int) + 1
    return Grid(low, pitch, np.full(tuple(shape), np.inf, dtype=np.float32))


def _inside(view: View, distances: NDArray[np.float32], points_m: Array) -> NDArray[np.float32]:
    """How far points [N, 3] are inside the outline of a view [N], in metres."""
    pixels, depth = project(points_m, view.world_from_camera, view.intrinsics_px)
    found = map_coordinates(distances, (pixels[:, 1] + 0.5, pixels[:, 0] + 0.5), order=1, mode="nearest")
    height, width = view.mask.shape
    beyond = np.maximum(np.maximum(-pixels, pixels - (width, height)).max(1), 0.0)
    return np.where(depth > 0, (found - beyond) * depth / view.intrinsics_px[0], -np.inf).astype(np.float32)


def _agreeing(views: list[View], distances: list[NDArray[np.float32]], grid: Grid) -> list[int]:
    """The numbers of the views whose outlines agree with one another.

    What all outlines share must cover each of them. Where it does not, a view is left out: one that is not covered
    although the others are, else the one that excludes most of what few others exclude.
    """
    points, half = grid.points_m, grid.pitch_m / 2
    excluded = np.stack([_inside(view, distance, points) <= -half
                         for view, distance in zip(views, distances, strict=True)])
    kept = list(range(len(views)))
    while kept:
        excluders = excluded[kept].sum(0)
        hull = points[excluders == 0]
        covered = np.array([_covered(views[k], hull, grid.pitch_m) for k in kept])
        if covered.min() >= COVERED:
            break
        if np.median(covered) >= COVERED:
            kept.pop(int(covered.argmin()))
        else:
            blame = (excluded[kept] / np.maximum(excluders, 1) ** 2).sum(1)
            kept.pop(int(blame.argmax()))
    return kept


def _covered(view: View, points: Array, pitch_m: float) -> float:
    """The share of a view's mask that points [N, 3] of a grid cover."""
    pixels, depth = project(points, view.world_from_camera, view.intrinsics_px)
    if not len(points) or depth.min() <= 0:
        return 0.0
    side = max(1.0, 1.5 * pitch_m * view.intrinsics_px[0] / float(np.median(depth)))
    rows, columns = np.nonzero(view.mask)
    cells = np.zeros((int(view.mask.shape[0] / side) + 3, int(view.mask.shape[1] / side) + 3), dtype=bool)
    at = np.clip((pixels / side).astype(int) + 1, 0, (cells.shape[1] - 1, cells.shape[0] - 1))
    cells[at[:, 1], at[:, 0]] = True
    return float(cells[(rows / side).astype(int) + 1, (columns / side).astype(int) + 1].mean())


def _carved(grid: Grid, views: list[View], distances: list[NDArray[np.float32]]) -> Grid:
    """The grid after all views have said how far its points are inside."""
    points, least = grid.points_m, np.full(grid.inside_m.size, np.inf, dtype=np.float32)
    for view, distance in zip(views, distances, strict=True):
        near = least > -2 * grid.pitch_m  # what is farther outside stays outside
        least[near] = np.minimum(least[near], _inside(view, distance, points[near]))
    return replace(grid, inside_m=np.maximum(least, -3 * grid.pitch_m).reshape(grid.inside_m.shape))
