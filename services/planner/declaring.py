"""When the agent says that the camera is at the goal's view.

Two things must agree: the looks from there, and what all views together say. Where another direction was once about as
likely, as with the two sides of a can, the agent looks from there too before it says so, unless the looks are clear. If
the looks from both sides are good, the better ones decide: of all views there are more from where it was longer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saccade.shared.bus.messages import Belief
from saccade.shared.world.directions import alike
from saccade.shared.world.geometry import Array, direction, rotation_angle, rotation_towards, unit, viewing_grid

CERTAIN = 0.9  # chosen: beside a rival, or if the target is hidden, the posterior must be so sure
ALIKE = 0.45  # chosen: so well a view must agree; nearly all from the goal's direction do, and no back of a can
CLEARLY_ALIKE = 0.7  # chosen: beside a rival a view must agree so well; views of another side hardly ever do
IN_PART = 0.2  # chosen: a view that agrees so well is not given up, but the agent looks beside it
SURE = 0.6  # chosen: the agent says so if looks and fused views together leave at least this probability
COMPARED = 0.8  # chosen: and of a view that was compared at least this
FROM_ABOVE = 0.98  # chosen: sine of the elevation from which on a small move changes the azimuth much
ALIKE_ABOVE = 0.4  # chosen: from there a view that agrees so well is the goal's
UNLIKELY = 0.25  # chosen: a view that has a lower probability is not the goal's
CLEAR = 0.93  # chosen: looks that are clearer than this need no look at rivals; a view that may be wrong reaches 0.95
FLOOR = 0.02  # chosen: neither the looks nor the fused views count as surer than this leaves
RIVAL = 0.1  # chosen: a direction with this probability around it is a rival of the likeliest one
BESIDE, BESIDE_RAD = 6, 0.22  # chosen: from how many directions around a view the agent looks, and how far from it
AROUND_RAD, APART_RAD = 0.4, 0.8  # chosen: what counts as around a direction, and as far from it


class Evidence(NamedTuple):
    """What speaks for the goal's view being here: the probability by the looks from here, that by all views, whether a
    rival direction is left from which the agent has not looked, the probability by the best looks elsewhere, and
    how well the view agrees with the goal image, if it was compared: then the probability by all views holds all of
    this. Where other views were `compared`, and this one shows the object too large or elsewhere, more is asked for.
    From right `above`, the azimuth of the camera says little of how the image is turned, and with it the probability by
    all views; how well the view agrees says it."""

    look: float
    fused: float
    rival: bool = False
    elsewhere: float = 0.0
    agreement: float | None = None
    compared: bool = False
    above: bool = False

    @property
    def probability(self) -> float:
        """The probability that the goal's view is here."""
        if self.agreement is not None and self.above:
            return 1.0 - FLOOR if self.agreement > ALIKE_ABOVE else 0.0
        if self.agreement is not None:
            return self.fused if self.agreement > ALIKE else 0.0
        return together(self.look, self.fused if self.elsewhere < UNLIKELY else 1.0 - self.elsewhere)

    @property
    def is_beside(self) -> bool:
        """Whether the view agrees in part, so that the goal's may be beside it."""
        return self.agreement is not None and self.agreement > IN_PART

    @property
    def is_enough(self) -> bool:
        """Whether the agent says that the camera is there."""
        if self.look == 0.0 and self.agreement is None:  # something hides the target, so that this view says nothing
            return self.fused > CERTAIN and not self.rival
        if self.agreement is not None:
            is_clear = self.probability > CERTAIN and self.agreement > CLEARLY_ALIKE
            return is_clear if self.rival else self.probability > COMPARED
        return self.probability > (CERTAIN if self.compared else SURE) and (self.look > CLEAR or not self.rival)


def together(looks: float, fused: float) -> float:
    """The probability that two sources of evidence give together, each of which alone gives one: the product of their
    odds."""
    odds = np.prod([p / (1 - p) for p in np.clip([looks, fused], FLOOR, 1 - FLOOR)])
    return float(odds / (1 + odds))


def fused_here(target: Belief, camera: Array, symmetry: int) -> float:
    """Probability by all views that the goal image was taken from about the direction of a camera [4, 4]. 0 without a
    posterior."""
    if target.goal_log_posterior is None:
        return 0.0
    share, rolled = np.exp(target.goal_log_posterior.astype(np.float64)), target.goal_rotations is not None
    return float(share[alike(camera[:3, 3], target.mean_m, symmetry, rolled=rolled)].sum() / share.sum())


def around(towards: Array) -> list[Array]:
    """Directions [3] around one: BESIDE_RAD from it, the one from higher up first."""
    aside = unit(np.cross([0.0, 0.0, 1.0], towards) if np.hypot(*towards[:2]) > FLOOR else np.array([1.0, 0.0, 0.0]))
    up = np.cross(towards, aside)
    return [np.cos(BESIDE_RAD) * towards + np.sin(BESIDE_RAD) * (np.cos(angle) * up + np.sin(angle) * aside)
            for angle in np.linspace(0.0, 2 * np.pi, BESIDE, endpoint=False)]


class Rivals:
    """Directions [3] from the target that have once been likely, and from which the agent has not looked yet.

    How far two directions are apart is how far the camera is turned between the views: nearly above the target, views
    from about one place may show it turned.
    """

    def __init__(self) -> None:
        self.directions: list[Array] = []
        self._seen: list[tuple[Array, float]] = []  # directions, and the looks from there

    def take(self, target: Belief) -> None:
        """Takes the directions that are likely by now: the likeliest, and the likeliest that is far from it."""
        if target.goal_log_posterior is None:
            return
        share = np.exp(target.goal_log_posterior.astype(np.float64)).ravel()
        share /= share.sum()
        rows, columns = viewing_grid()
        towards = direction(*reversed(np.meshgrid(rows, columns, indexing="ij"))).reshape(-1, 3)
        left = np.ones(len(share), dtype=bool)
        for _ in range(2):
            peak = towards[np.argmax(np.where(left, share, -1.0))]
            apart = turn_between(peak, towards)
            if share[apart < AROUND_RAD].sum() < RIVAL:
                return
            if all(turn_between(peak, known) > APART_RAD
                   for known in (*self.directions, *(seen for seen, _ in self._seen))):
                self.directions.append(peak)
            left &= apart > APART_RAD

    def looked(self, camera: Array, center: Array, look: float) -> None:
        """The agent has looked at the target from the pose of a camera [4, 4]: the probability by these looks."""
        here = unit(camera[:3, 3] - center)
        self._seen = [each for each in self._seen if turn_between(here, each[0]) > AROUND_RAD] + [(here, look)]
        self.directions = [each for each in self.directions if turn_between(here, each) > APART_RAD]

    def elsewhere(self, camera: Array, center: Array) -> float:
        """The best look from a direction far from that of a camera [4, 4]. 0 if there was none."""
        here = unit(camera[:3, 3] - center)
        return max((look for seen, look in self._seen if turn_between(here, seen) > APART_RAD), default=0.0)

    def beside(self, camera: Array, center: Array) -> Array | None:
        """A rival [3] of the direction of a camera [4, 4]. None if there is none."""
        here = unit(camera[:3, 3] - center)
        return next((each for each in self.directions if turn_between(here, each) > APART_RAD), None)


def turn_between(one: Array, others: Array) -> Array:
    """The angles (rad) by which cameras are turned that look from directions `others` [..., 3], against one that looks
    from `one` [3], all of them without roll."""
    return rotation_angle(rotation_towards(-others), rotation_towards(-one))
