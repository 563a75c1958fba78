"""Whether an object that no image has shown yet may be there: the places where it could stand unseen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

APART_M = 0.05  # chosen: between two places
NEAR_MIDDLE_M = 0.12  # fitted to scenes of the default suite: deviation from the table's middle, along x and y
MIDDLE_HIGH_M = 0.06  # chosen: how high above the table the middles of objects are
OVERLOOKED = 0.05  # chosen: probability that an object in clear view is not seen
ALWAYS_OVERLOOKED = 0.02  # chosen: the same of any number of views, since successive views are alike


class Unseen:
    """Places on the table, points [N, 3] (m, world): how likely an object stands there, and has been overlooked there.

    `extent_m` [3, 2] is where objects may be; its lower end along z is the table's top.
    """

    def __init__(self, extent_m: Array):
        x, y = (np.arange(low + APART_M / 2, high, APART_M) for low, high in extent_m[:2])
        self.points = np.array([[a, b, extent_m[2, 0] + MIDDLE_HIGH_M] for a in x for b in y])
        prior = np.exp(-0.5 * ((self.points[:, :2] - extent_m[:2].mean(1)) ** 2).sum(1) / NEAR_MIDDLE_M ** 2)
        self.prior = prior / prior.sum()
        self.overlooked = np.ones(len(prior))  # probability of all images so far, if the object stood there

    def missed(self, clear: NDArray[np.bool_]) -> None:
        """Takes an image that does not show the object. `clear` [N] says which places it shows."""
        self.overlooked[clear] = np.maximum(self.overlooked[clear] * OVERLOOKED, ALWAYS_OVERLOOKED)

    @property
    def log_likelihood(self) -> float:
        """Log probability of the images so far, if the object is there; if it is not, they are certain."""
        return float(np.log(self.prior @ self.overlooked))

    def log_overlooked(self, place: Array) -> float:
        """Log probability of the images so far, if the object is at a place [3] (m)."""
        return float(np.log(self.overlooked[np.argmin(((self.points - place) ** 2).sum(1))]))
