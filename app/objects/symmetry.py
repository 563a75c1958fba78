"""Finds the rotational symmetry of an object about its up axis, by looking at it from around.

An object is symmetric under a turn if no view changes with it by more than what drawing it anew changes. Where an image
is resampled with a shift, each pixel becomes a mean of its neighbours, so that it stays between the least and the most
of them. So a pixel differs only by what it lies outside the least and the most of the neighbours in the turned view.
What is left of differences that are resampling's is measured by a view that is drawn with its grid of pixels moved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at
from saccade.shared.world.symmetry import CONTINUOUS, MOST, NONE
from saccade.shared.world.windows import CROP_PX

DIAGONAL_M = 0.5  # to which an object is scaled, so that it is well between the near and the far plane
HALF_ANGLE = 0.35  # the tangent of half the angle that the object covers
SAMPLES = 2  # in a pixel, along each side
ELEVATIONS_RAD = (0.15, 1.0)
STARTS = 12  # views from around that are compared with turned ones
GRID_PX = 0.5  # how far the grid of pixels is moved to measure what resampling changes: farther is the next pixel
NEIGHBOURS_PX = 5  # chosen: a pixel is compared with the square of this side in the turned view
TOGETHER_PX = 3  # chosen: differences are averaged over squares of this side: grain goes, and what has a shape stays
# Chosen: what counts as different in the largest of the colours' three channels, in the outline and in the relief; the
# last one is in diagonals of the object.
DIFFERENT = {"colour": 0.06, "outline": 0.1, "relief": 0.015}
CHANNELS = {"colour": slice(0, 3), "outline": slice(3, 4), "relief": slice(4, 5)}
# Chosen: the share of the outline that may differ beyond what resampling changes, which counts up to the same share. Of
# 23 scanned objects, turned views of those without symmetry differ in 16 % or more, of those with one in 5 % or less.
# What resampling changes is below 2 % but for two objects that are thin where they are seen from the side.
LIMIT = 0.05

Views = NDArray[np.float32]


def symmetry_of(mesh: Mesh) -> int:
    """The symmetry of a mesh about the vertical axis through the middle of its box, see `shared/world/symmetry.py`.
    Raises SaccadeError if OpenGL does not work."""
    around = Around(mesh)
    try:
        if not any(around.looks_the_same(MOST // prime) for prime in (2, 3, 5)):
            return NONE  # any symmetry has one of these
        orders = [order for order in range(MOST, 1, -1) if MOST % order == 0]
        found = next((order for order in orders if all(
            around.looks_the_same(MOST // order * k) for k in range(1, order // 2 + 1))), NONE)
        return CONTINUOUS if found == MOST else found
    finally:
        around.close()


class Around:
    """Views of an object from all around, drawn when they are needed. A turn is counted in parts of MOST."""

    def __init__(self, mesh: Mesh) -> None:
        scale = DIAGONAL_M / float(np.linalg.norm(mesh.size_m))
        self.mesh = replace(mesh, vertices_m=(mesh.vertices_m * scale).astype(np.float32))
        self.range_m = 1.05 * DIAGONAL_M / 2 / HALF_ANGLE
        self.world = World((self.mesh,), size_px=SAMPLES * CROP_PX)
        self.world.show_table(False)
        self._bounds: dict[int, tuple[Views, Views]] = {}
        self._views: dict[int, Views] = {}
        self._same: dict[int, bool] = {}
        noise = max(self._difference(self._drawn(start, GRID_PX), start) for start in (0, MOST // 8, MOST // 4))
        self.limit = LIMIT + min(noise, LIMIT)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self.world.close()

    def looks_the_same(self, turn: int) -> bool:
        """Whether all views look the same after a turn."""
        if turn not in self._same:
            self._same[turn] = all(self._difference(self._view(start), start + turn) <= self.limit
                                   for start in range(0, MOST, MOST // STARTS))
        return self._same[turn]

    def _difference(self, views: Views, other: int) -> float:
        """The share of the outline in which views differ from those of another azimuth, in the worst of them."""
        lower, upper = self._between(other % MOST)
        beyond = np.maximum(np.maximum(lower - views, views - upper), 0.0)
        outline = np.maximum(views[..., 3].sum((1, 2)), 1.0)
        shares = []
        for kind, channel in CHANNELS.items():
            largest = uniform_filter(beyond[..., channel].max(-1), (0, TOGETHER_PX, TOGETHER_PX), mode="constant")
            shares.append(float(((largest > DIFFERENT[kind]).sum((1, 2)) / outline).max()))
        return max(shares)

    def _view(self, azimuth: int) -> Views:
        if azimuth not in self._views:
            self._views[azimuth] = self._drawn(azimuth)
        return self._views[azimuth]

    def _between(self, azimuth: int) -> tuple[Views, Views]:
        """The least and the most of the neighbours of each pixel."""
        if azimuth not in self._bounds:
            square = (1, NEIGHBOURS_PX, NEIGHBOURS_PX, 1)
            self._bounds[azimuth] = (minimum_filter(self._view(azimuth), square),
                                     maximum_filter(self._view(azimuth), square))
        return self._bounds[azimuth]

    def _drawn(self, azimuth: int, moved_px: float = 0.0) -> Views:
        """The views from an azimuth [elevations, 64, 64, 5]: colours, coverage and relief, which is how far a point
        is in front of the farthest one, in diagonals. Colours and relief are premultiplied by the coverage."""
        size = SAMPLES * CROP_PX
        focal, middle = size / 2 / HALF_ANGLE, size / 2 + SAMPLES * moved_px
        self.world.set_intrinsics((focal, focal, middle, middle))
        self.world.place({self.mesh.name: (np.zeros(3), 0.0)})
        views = []
        for elevation in ELEVATIONS_RAD:
            camera = look_at(self.range_m * direction(2 * np.pi / MOST * azimuth, elevation), np.zeros(3))
            depth = self.world.render_depth(camera)
            covered = depth < self.range_m + DIAGONAL_M
            relief = np.where(covered, (self.range_m + DIAGONAL_M / 2 - depth) / DIAGONAL_M, 0.0)
            layers = np.dstack([self.world.render(camera) / 255.0 * covered[..., None], covered, relief])
            views.append(layers.reshape(CROP_PX, SAMPLES, CROP_PX, SAMPLES, -1).mean((1, 3)))
        return np.stack(views).astype(np.float32)
