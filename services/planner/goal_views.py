"""Where the camera would see what the goal image shows: at the peak of the posterior over the goal's direction.

Of a symmetric target several views look the same. The agent goes to the nearest one that it can reach, and what it has
found out at one of them holds for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import Array, direction, spherical, viewing_grid, wrap
from saccade.shared.world.symmetry import CONTINUOUS, NONE, about_vertical, turned_about, turns_of
from saccade.shared.world.task import SUCCESS_TRANSLATION_M, Spheres, clip

PEAK_ROWS = 2  # chosen: the posterior's peak is averaged over this many cells of elevation on each side
PEAK_COLUMNS = 4  # chosen: the posterior's peak is averaged over this many cells of azimuth on each side


def peak_eye(target: Belief, range_m: float, symmetry: int, camera: Array, spheres: Spheres) -> Array:
    """The camera position [3] at the goal's range in the direction of the posterior's peak. Of those that look the same
    it is the nearest to the camera's pose [4, 4] outside the spheres."""
    assert target.goal_log_posterior is not None  # as the caller has asked
    eye = _peak(target.mean_m, target.goal_log_posterior, range_m)
    if symmetry == NONE:
        return eye
    eyes = target.mean_m + about_vertical(turns_of(symmetry)) @ (eye - target.mean_m)
    is_blocked = np.linalg.norm(clip(eyes, spheres) - eyes, axis=1) > SUCCESS_TRANSLATION_M
    nearest_first = np.lexsort([np.linalg.norm(eyes - camera[:3, 3], axis=1), is_blocked])
    return np.asarray(eyes[nearest_first[0]])


def _peak(center: Array, log_posterior: NDArray[np.float32], range_m: float) -> Array:
    """The camera position [3] at the goal's range in the direction of the posterior's peak.

    The peak is averaged over its neighbours in the grid. Azimuth and elevation are averaged separately, because near
    the pole two positions may be neighbours although their images are rotated by half a turn.
    """
    elevation, azimuth = viewing_grid()
    fine = log_posterior.astype(np.float64)
    row, column = map(int, np.unravel_index(np.argmax(fine), fine.shape))
    rows = np.arange(max(row - PEAK_ROWS, 0), min(row + PEAK_ROWS + 1, len(elevation)))
    columns = np.arange(column - PEAK_COLUMNS, column + PEAK_COLUMNS + 1) % len(azimuth)
    mass = np.exp(fine[np.ix_(rows, columns)] - fine[row, column])
    mass /= mass.sum()
    mean_azimuth = azimuth[column] + (mass * wrap(azimuth[columns] - azimuth[column])).sum()
    mean_elevation = (mass * elevation[rows][:, None]).sum()
    return center + range_m * direction(mean_azimuth, mean_elevation)


@dataclass(frozen=True)
class Side:
    """The part of the directions around a target at `center` [3] that lies around the position `eye` [3]. Any view of a
    symmetric target looks like one from there."""

    center: Array
    symmetry: int
    eye: Array

    def eyes(self, eyes: Array) -> Array:
        """Positions [N, 3], turned to this side by what makes no difference."""
        if self.symmetry == NONE:
            return eyes
        across = eyes - self.center
        return self.center + np.einsum("nij,nj->ni", about_vertical(self._turns(eyes)), across)

    def pose(self, pose: Array) -> Array:
        """A camera pose [4, 4], turned to this side."""
        if self.symmetry == NONE:
            return pose
        return turned_about(self.center, pose, self._turns(pose[None, :3, 3]))[0]

    def _turns(self, eyes: Array) -> Array:
        aside = spherical(eyes, self.center)[0] - spherical(self.eye, self.center)[0]
        if self.symmetry == CONTINUOUS:
            return -aside
        part = 2 * np.pi / self.symmetry
        return -part * np.round(aside / part)
