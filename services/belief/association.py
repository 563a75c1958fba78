"""Which percept is of which instance of a kind, which instances are new, and how many there are.

One image gives each percept to the instance that explains it best, and to none twice (a global nearest-neighbour
filter). What remains of them is born: an instance begins where a percept lies clearly apart. An instance dies when its
place is in clear view and nothing is seen there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from saccade.services.belief.position import MODEL_STD_M, Evidence, Moments

Array = NDArray[np.float64]

LOG_BIRTH = float(np.log(0.01 / 0.5))  # chosen: log density of a new instance, per cubic metre of the workspace
BIRTH_LOG_ODDS = 2.0  # chosen: by so much more than its percept's an instance's log odds are lower when it is born
LEFT_LOG_ODDS = 0.4  # chosen: log odds that one is where another one was seen before, while nobody looks there
MORE = 0.3  # chosen: probability that there is one more of several, before anybody has looked for it
SURE = 0.9  # chosen: presence from which on an instance is surely one of several
APART = 0.9  # chosen: an instance is born only if it is farther than so many of its radii from all others
VAGUE_M = 0.12  # chosen: no instance is born from a percept with a larger deviation
DEAD_LOG_ODDS = -2.0  # chosen: an instance dies if its log odds of being there are lower, unless it is the last one
LOST_M = 0.2  # chosen: nor is one kept whose place is not known to this deviation, while others are
MOST = 8  # chosen: instances of a kind
SAME = 0.6  # chosen: two instances, or percepts of an image, nearer to each other than so many radii are one


def assigned(places: Sequence[Moments], percepts: Sequence[Evidence]) -> list[int | None]:
    """The number of the percept that each instance at `places` has. None if it has none. All together are as likely as
    can be; a percept that fits an instance less than a new one is given to none."""
    if not len(places) or not len(percepts):
        return [None] * len(places)
    cost = np.array([[-_log_density(place, evidence) for evidence in percepts] for place in places])
    nobody = np.full((len(places), len(places)), -LOG_BIRTH)
    rows, columns = linear_sum_assignment(np.hstack([cost, nobody]))
    found: list[int | None] = [None] * len(places)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        found[row] = column if column < len(percepts) else None
    return found


def _log_density(place: Moments, evidence: Evidence) -> float:
    """Log density of a percept if it is of what is at a place."""
    spread = place[1] + evidence.covariance + np.eye(3) * MODEL_STD_M ** 2
    offset = evidence.mean - place[0]
    return float(-0.5 * (offset @ np.linalg.solve(spread, offset) + np.linalg.slogdet(2 * np.pi * spread)[1]))


def is_apart(point: Array, others: Sequence[Array], least_m: float) -> bool:
    """Whether a point [3] is farther than `least_m` from all others [3]."""
    return all(float(np.linalg.norm(point - other)) > least_m for other in others)


def doubles(places: Sequence[Moments], presences: Sequence[float], least_m: float) -> list[int]:
    """The instances that are another one once more: nearer than `least_m` to one whose place is known better, or as
    well and that is likelier."""
    order = sorted(range(len(places)), key=lambda k: (float(np.trace(places[k][1])) > least_m ** 2, -presences[k], k))
    kept: list[int] = []
    for k in order:
        if is_apart(places[k][0], [places[j][0] for j in kept], least_m):
            kept.append(k)
    return sorted(set(range(len(places))) - set(kept))


def count_probabilities(presences: Sequence[float]) -> Array:
    """Probabilities that none, one, two and so on of the instances are there [N + 1], if each is there or not
    independently of the others."""
    shares = np.ones(1)
    for presence in presences:
        shares = np.convolve(shares, [1.0 - presence, presence])
    return shares
