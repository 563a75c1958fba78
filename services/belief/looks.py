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
PER_AGREEMENT, WITHOUT = 18.0, -6.5
AROUND_RAD = 0.15  # chosen: a comparison counts for directions within about this angle
FROM_ABOVE_RAD = 0.8  # chosen: from a higher elevation the turn of the image tells the goal's azimuth
SAME_RAD = 0.08  # chosen: of comparisons from within this angle the last counts


class Look(NamedTuple):
    """One comparison: where the camera was [3] (m, world), the log of the ratio of likelihoods, how many times farther
    than in this view the goal image shows the object, and by how much the goal's azimuth is another."""

    eye: Array
    log_ratio: float
    farther: float
    aside_rad: float


class Looks:
    """The comparisons of one object, which may be symmetric, in an episode."""

    def __init__(self, symmetry: int):
        self._equal_rad = turns_of(symmetry, GRID_AZIMUTHS)
        self._looks: list[Look] = []

    def take(self, eye: Array, center: Array, agreement: float, farther: float, roll_rad: float = 0.0) -> None:
        """Takes the agreement of the view from `eye` [3] of an object at `center` [3] (m, world), how many times
        farther the goal image shows it, and by what angle the image is turned to the right against the goal image.

        Seen from above, another azimuth turns the image, so that the angle tells the goal's azimuth.
        """
        _, elevation, _ = spherical(eye, center)
        log_ratio = WITHOUT + PER_AGREEMENT * agreement
        is_told = log_ratio > 0.0 and elevation > FROM_ABOVE_RAD
        towards = unit(eye - center)
        self._looks = [look for look in self._looks if unit(look.eye - center) @ towards < np.cos(SAME_RAD)]
        aside_rad = -roll_rad / float(np.sin(elevation)) if is_told else 0.0
        self._looks.append(Look(np.array(eye), log_ratio, farther, aside_rad))

    def carried(self, move_m: Array) -> None:
        """Moves the views along with an object that drifts by `move_m` [3] (metres)."""
        self._looks = [look._replace(eye=look.eye + move_m) for look in self._looks]

    def log_ratio(self, center: Array) -> Array | None:
        """The log of the ratio for each direction of the viewing grid [E, A], by the comparison from nearest to it.
        None before the first comparison."""
        if not self._looks:
            return None
        elevation, azimuth = viewing_grid()
        at_azimuth, at_elevation, _ = spherical(np.array([look.eye for look in self._looks]), center)
        up = elevation[:, None, None] - at_elevation
        aside = azimuth[:, None] - at_azimuth - np.array([look.aside_rad for look in self._looks])
        around = np.min([np.abs(wrap(aside + equal)) for equal in self._equal_rad], axis=0)
        way = np.hypot(up, around)  # [E, A, looks]: near the pole, too, a change of azimuth rotates the image
        nearest = way.argmin(-1)
        ratios = np.array([look.log_ratio for look in self._looks])[nearest]
        return np.asarray(ratios * np.exp(-0.5 * (way.min(-1) / AROUND_RAD) ** 2))

    def range_m(self, center: Array) -> float | None:
        """The range (m) at which the goal image shows the object, by the comparison that agrees best. None if none
        speaks for its direction.

        In two views from one direction the networks make the same error of the size, so that their ratio is exact.
        """
        best = max(self._looks, key=lambda look: look.log_ratio, default=None)
        if best is None or best.log_ratio < 0.0:
            return None
        return float(np.linalg.norm(best.eye - center)) * best.farther
