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
IN_PART = 0.2  # chosen: a view that agrees so well may be from beside the goal's direction
BESIDE_RAD = (0.06, 0.6)  # chosen: how far beside
WORTH_A_LOOK = 4.0  # chosen: what such a view makes of the log ratio there, at most
FIRST_RAD = 0.15  # chosen: a comparison from so much farther away decides before one that only points there
SAME_RAD = 0.08  # chosen: of comparisons from within this angle the last counts


class Look(NamedTuple):
    """One comparison: where the camera was [3] (m, world), the log of the ratio of likelihoods, how many times farther
    than in this view the goal image shows the object, by how much the goal's azimuth is another, and how well
    the view agrees."""

    eye: Array
    log_ratio: float
    farther: float
    aside_rad: float
    agreement: float


class Looks:
    """The comparisons of one object, which may be symmetric, in an episode."""

    def __init__(self, symmetry: int):
        self._equal_rad = turns_of(symmetry, GRID_AZIMUTHS)
        self._looks: list[Look] = []

    def take(self, eye: Array, center: Array, agreement: float, farther: float, aside_rad: float = 0.0) -> None:
        """Takes the agreement of the view from `eye` [3] of an object at `center` [3] (m, world), how many times
        farther the goal image shows it, and by how much larger the azimuth of the goal's view seems to be.

        A view that agrees in part, from beside the goal's direction, makes the direction worth a look to which it
        points; what is seen there decides.
        """
        towards = unit(eye - center)
        self._looks = [look for look in self._looks if unit(look.eye - center) @ towards < np.cos(SAME_RAD)]
        log_ratio = WITHOUT + PER_AGREEMENT * agreement
        points = agreement > IN_PART and BESIDE_RAD[0] < abs(aside_rad) < BESIDE_RAD[1]
        if points and log_ratio < WORTH_A_LOOK:
            log_ratio = min(log_ratio + PER_AGREEMENT * abs(aside_rad), WORTH_A_LOOK)
        self._looks.append(Look(np.array(eye), log_ratio, farther, aside_rad if points else 0.0,
                                agreement))

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
        later = np.array([FIRST_RAD if look.aside_rad else 0.0 for look in self._looks])  # what is seen there decides
        nearest = (way + later).argmin(-1)
        ratios = np.array([look.log_ratio for look in self._looks])[nearest]
        nearest_way = np.take_along_axis(way, nearest[..., None], -1)[..., 0]
        return np.asarray(ratios * np.exp(-0.5 * (nearest_way / AROUND_RAD) ** 2))

    def range_m(self, center: Array) -> float | None:
        """The range (m) at which the goal image shows the object, by the comparison that agrees best. None if none
        speaks for its direction.

        In two views from one direction the networks make the same error of the size, so that their ratio is exact.
        """
        best = max(self._looks, key=lambda look: look.agreement, default=None)
        if best is None or WITHOUT + PER_AGREEMENT * best.agreement < 0.0:
            return None
        return float(np.linalg.norm(best.eye - center)) * best.farther
