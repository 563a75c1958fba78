"""What comparisons of views with the goal image, at the resolution that is there, say of the goal's direction.

A view from the goal's direction agrees with the goal image, one from beside it agrees in part and points to it, and one
from elsewhere hardly agrees. So each comparison makes directions around its own likelier or less likely than they were,
and says nothing of others. Where two sides of an object have been looked at, the posterior weighs both comparisons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import GRID_AZIMUTHS, spherical, viewing_grid, wrap
from saccade.shared.world.symmetry import turns_of

Array = NDArray[np.float64]

# Fitted to 1,500 views of goals of ten objects: the agreement from the goal's own direction, within what angle it falls
# to the e-th part, its standard deviation, and its mean from elsewhere, where it is distributed exponentially; but a
# share of such views shows a side that is much like the goal's, and a share of views from the goal's own direction
# fails to agree: these may agree however much.
AGREES, WITHIN_RAD, AGREES_STD, ELSEWHERE = 0.7, 0.29, 0.13, 0.05
LIKE_IT, FAILS = 0.06, 0.08
UNEXPLAINED = 0.01  # chosen: share of views from anywhere that agree as those from elsewhere do
POINTS = 0.12  # chosen: views that agree more than this point to the goal's direction
POINTS_RIGHTLY = 0.8  # chosen: share of them that do so rightly
POINTS_STD_RAD, ANYHOW_RAD = 0.08, 0.3  # fitted: how exactly, and how far those that do not point to it point aside
TURNED = 0.5  # chosen: from above, another azimuth turns the image: what this counts, in ways along the sphere
# Chosen: a comparison from farther than this from the best one counts for so much less (nats, for what it agrees less)
# and at most so much less, if the best one agrees so well. Of two sides that look much alike the goal's agrees better.
OTHER_SIDE_RAD, PER_LESS, AT_MOST, WELL = 0.6, 30.0, 6.0, 0.5
SAME_RAD = 0.08  # chosen: of comparisons from within this angle the last counts


class Look(NamedTuple):
    """One comparison: where the camera was [3] (m, world), how well the view agrees, how many times farther than in
    this view the goal image shows the object, and by how much the goal's azimuth and elevation seem to be others."""

    eye: Array
    agreement: float
    farther: float
    aside_rad: float
    above_rad: float


class Looks:
    """The comparisons of one object, which may be symmetric, in an episode."""

    def __init__(self, symmetry: int):
        self._equal_rad = turns_of(symmetry, GRID_AZIMUTHS)
        self._looks: list[Look] = []

    def take(self, eye: Array, center: Array, agreement: float, farther: float, aside_rad: float = 0.0,
             above_rad: float = 0.0) -> None:
        """Takes the agreement of the view from `eye` [3] of an object at `center` [3] (m, world), how many times
        farther the goal image shows it, and by how much larger azimuth and elevation of the goal's view seem to be."""
        self._looks = [look for look in self._looks if _between(look.eye, eye, center) > SAME_RAD]
        self._looks.append(Look(np.array(eye), agreement, farther, aside_rad, above_rad))

    def carried(self, move_m: Array) -> None:
        """Moves the views along with an object that drifts by `move_m` [3] (metres)."""
        self._looks = [look._replace(eye=look.eye + move_m) for look in self._looks]

    def log_ratio(self, center: Array) -> Array | None:
        """The log of how much likelier the comparison from nearest to it is, if this is the goal's direction, than if
        the goal's is elsewhere, for each direction of the viewing grid [E, A]. None before the first comparison."""
        if not self._looks:
            return None
        elevation, azimuth = viewing_grid()
        at_azimuth, at_elevation, _ = spherical(np.array([look.eye for look in self._looks]), center)
        up = np.broadcast_to(elevation[:, None, None] - at_elevation,
                             (len(elevation), len(azimuth), len(self._looks)))
        turned = wrap(azimuth[:, None, None] - at_azimuth[:, None] + self._equal_rad)
        least = np.abs(turned).argmin(-1)
        around = np.broadcast_to(np.take_along_axis(turned, least[..., None], -1)[..., 0], up.shape)
        nearest = _way(up, around, at_elevation).argmin(-1)[..., None]
        up, around = (np.take_along_axis(each, nearest, -1)[..., 0] for each in (up, around))
        agreement, aside, above = (np.array([getattr(look, of) for look in self._looks])[nearest[..., 0]]
                                   for of in ("agreement", "aside_rad", "above_rad"))
        height, way = at_elevation[nearest[..., 0]], _way(up, around, at_elevation[nearest[..., 0]])
        ratio = _log_ratio(agreement, way, _way(up - above, around - aside, height))
        return ratio - _near(way) * self._worse(center)[nearest[..., 0]]

    def _worse(self, center: Array) -> Array:
        """By how many nats each comparison counts less because another side agrees better [looks]."""
        best = max(self._looks, key=lambda look: look.agreement)
        if len(self._equal_rad) > 1 or best.agreement < WELL:
            return np.zeros(len(self._looks))
        other = _between(np.array([look.eye for look in self._looks]), best.eye, center) > OTHER_SIDE_RAD
        less = np.array([best.agreement - look.agreement for look in self._looks])
        return np.asarray(other * np.minimum(PER_LESS * less, AT_MOST))

    def range_m(self, center: Array) -> float | None:
        """The range (m) at which the goal image shows the object, by the comparison that agrees best. None if none
        speaks for its direction.

        In two views from one direction the networks make the same error of the size, so that their ratio is exact.
        """
        best = max(self._looks, key=lambda look: look.agreement, default=None)
        if best is None or _log_ratio(np.array(best.agreement), np.zeros(()), np.zeros(())) < 0.0:
            return None
        return float(np.linalg.norm(best.eye - center)) * best.farther


def _way(up: Array, around: Array, elevation: Array) -> Array:
    """How far two views of an object are apart (rad) which differ by these angles, at an elevation."""
    return np.sqrt(up ** 2 + around ** 2 * (np.cos(elevation) ** 2 + (TURNED * np.sin(elevation)) ** 2))


def _between(eyes: Array, other: Array, center: Array) -> Array:
    """How far the views from positions [..., 3] of an object at `center` [3] (m) are from one from another [3], rad."""
    (azimuth, elevation, _), (azimuth_there, elevation_there, _) = spherical(eyes, center), spherical(other, center)
    return _way(elevation_there - elevation, wrap(azimuth_there - azimuth), elevation)


def _near(way: Array) -> Array:
    """What part of the agreement from the goal's own direction a view has from beside it, `way` (rad) away."""
    return np.asarray(np.exp(-(way / WITHIN_RAD) ** 2))


def _log_ratio(agreement: Array, way: Array, beside: Array) -> Array:
    """The log of how much likelier an agreement is if the goal's direction is `way` (rad) from here, and `beside` (rad)
    from where the view points to, than if it is elsewhere."""
    near = _near(way)
    elsewhere = (1.0 - LIKE_IT) * np.exp(-agreement / ELSEWHERE) / ELSEWHERE + LIKE_IT
    apart = (agreement - AGREES * near) / AGREES_STD
    here = (1.0 - FAILS) * np.exp(-0.5 * apart ** 2) / (AGREES_STD * np.sqrt(2 * np.pi)) + FAILS
    spread = (ANYHOW_RAD / POINTS_STD_RAD) ** 2 * np.exp(-0.5 * (beside / POINTS_STD_RAD) ** 2)
    points = np.where(agreement > POINTS, POINTS_RIGHTLY * spread + 1.0 - POINTS_RIGHTLY, 1.0)
    return np.asarray(np.log(near * here * points / elsewhere + 1.0 - near + UNEXPLAINED))
