"""What comparisons of views with the goal image, at the resolution that is there, say of the goal's direction.

A view from the goal's direction agrees with the goal image, and one from elsewhere does not. So each comparison makes
its own direction likelier or less likely than it was, and says nothing of others. Where two sides of an object have
been looked at, the posterior weighs both comparisons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import GRID_AZIMUTHS, spherical, unit, viewing_grid, wrap
from saccade.shared.world.symmetry import turns_of

Array = NDArray[np.float64]

# Fitted to views of 150 development scenes: log of how much likelier an agreement is from the goal's direction
# than from elsewhere.
PER_AGREEMENT, WITHOUT = 13.0, -4.3
AROUND_RAD = 0.2  # chosen: a comparison counts for directions within about this angle
SAME_RAD = 0.08  # chosen: of comparisons from within this angle the last counts


class Look(NamedTuple):
    """One comparison: where the camera was [3] (m, world), and the log of the ratio of likelihoods."""

    eye: Array
    log_ratio: float


class Looks:
    """The comparisons of one object, which may be symmetric, in an episode."""

    def __init__(self, symmetry: int):
        self._equal_rad = turns_of(symmetry, GRID_AZIMUTHS)
        self._looks: list[Look] = []

    def take(self, eye: Array, center: Array, agreement: float) -> None:
        """Takes the agreement of the view from `eye` [3] of an object at `center` [3] (m, world)."""
        towards = unit(eye - center)
        self._looks = [look for look in self._looks if unit(look.eye - center) @ towards < np.cos(SAME_RAD)]
        self._looks.append(Look(np.array(eye), WITHOUT + PER_AGREEMENT * agreement))

    def log_ratio(self, center: Array) -> Array | None:
        """The log of the ratio for each direction of the viewing grid [E, A], by the comparison from nearest to it.
        None before the first comparison."""
        if not self._looks:
            return None
        elevation, azimuth = viewing_grid()
        at_azimuth, at_elevation, _ = spherical(np.array([look.eye for look in self._looks]), center)
        up = elevation[:, None, None] - at_elevation
        aside = azimuth[:, None] - at_azimuth
        around = np.min([np.abs(wrap(aside + equal)) for equal in self._equal_rad], axis=0)
        way = np.hypot(up, around)  # [E, A, looks]: near the pole, too, a change of azimuth rotates the image
        nearest = way.argmin(-1)
        ratios = np.array([look.log_ratio for look in self._looks])[nearest]
        return np.asarray(ratios * np.exp(-0.5 * (way.min(-1) / AROUND_RAD) ** 2))
