"""From which direction an object would look like the goal image: a posterior that is fused from all views.

The directions are the cells of a grid on the hemisphere above the object. For each view, the CCN's transition moves the
latent pose of the view to every cell. A cell is as likely as the goal's latent pose is under the moved one (paper,
equations 2 and 5). A view from about the same direction is also compared with the goal's directly, which tells apart
sides that look alike. The likelihoods of views from different places are multiplied. For a nearly symmetric object the
posterior may have several modes; new views decide between them. Percepts that tell rotations in place of a latent pose
are fused over the turn of the object (`services/belief/turn.py`), or over all its rotations where it may lie
(`services/belief/attitude.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from saccade.services.belief.attitude import Views
from saccade.services.belief.looks import Looks
from saccade.services.belief.turn import GoalDirections, turn_probability
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.model.latent import LatentTransition, log_density
from saccade.shared.world.directions import alike
from saccade.shared.world.geometry import (
    GRID_AZIMUTHS,
    GRID_ELEVATIONS,
    REFERENCE_RANGE_M,
    direction,
    spherical,
    unit,
    viewing_grid,
    wrap,
)
from saccade.shared.world.symmetry import NONE, turns_of

Array = NDArray[np.float64]

OUTLIER = 0.05  # chosen: probability that the latent pose of a view says nothing about the goal's direction
SAME_RAD = 0.5  # chosen: two views within about this angle are compared directly, too
# Measured between views within 0.35 rad: deviation of a latent pose moved by the change of the transition, for views
# from the same direction (with half a cell of the grid) and for each radian between them.
SAME_STD, SAME_STD_PER_RAD = 0.065, 0.25
DIRECT = 0.97  # chosen: probability that the direct comparison of two views from the same direction holds
USUAL = 1.5  # chosen: variance, in units of those, up to which a view looks like the goal
LEAST_SHARE = 1e-3  # chosen: where the direct comparison counts less than this it is left out
NEW_VIEW_RAD = 0.08  # chosen: two views within this angle count as the same view; a little less than a cell of the grid
BETTER = 1.2  # chosen: a view replaces the same kept view if its quality is higher by this factor
CERTAIN = 0.03  # chosen: the quality of a view is its presence / (this + standard deviation of its log scale)
NEAR_RAD = 0.35  # chosen: views within about this angle of the goal's likeliest direction count more
NEAR_WEIGHT = 5.0  # chosen: what is added at most to the weight 1 of a view near the goal's likeliest direction
UNSURE = 0.1  # chosen: probability that the views without comparisons say nothing of the goal's direction
SAME_SCALE = 0.3  # chosen: weight of the prior that the goal's range is as measured; one near view has at most 1
FRESH_STEPS = 8  # chosen: views of a drifting object count for so many steps
MOVED_M = 0.01  # chosen: if the object's position changes by more than this, all displacements are computed again


class Likeness(Protocol):
    """What one view says of the goal's direction: log probabilities over something that is the same in all views."""

    def of(self, percept: Percept, center: Array) -> Array:
        """Log probabilities by one view alone of an object that is believed to be at `center` [3]."""

    def grid(self, log_probability: Array) -> Array:
        """Log probabilities of the directions of the viewing grid [E, A], from fused ones of that something."""

    def views(self, log_probability: Array) -> Views | None:
        """How the goal's camera was turned, from the same. None if it was not rolled, so that its direction says it."""


class LatentLikeness:
    """The likeness by latent poses, directly over the directions of the grid. `goal` is the object's percept in the
    goal image.

    The deviation of the transition does not become small where it hardly moves, and opposite sides of a can that look
    nearly alike are within it. So with `direct` a direction near that of the view is less likely if the view does not
    look like the goal. For this, its latent pose is moved by no more than the transition changes on the way, with a
    deviation that grows with the way. That a view looks like the goal says nothing against other directions: the object
    may be symmetric.
    """

    def __init__(self, transition: LatentTransition, goal: Percept, *, direct: bool = True):
        self.transition, self.direct = transition, direct
        self.goal_mean, self.goal_std = np.array(goal.latent_mean), np.array(goal.latent_std)
        elevation, azimuth = viewing_grid()
        self.elevation, self.azimuth = (x.ravel() for x in np.meshgrid(elevation, azimuth, indexing="ij"))

    def of(self, percept: Percept, center: Array) -> Array:
        """Log probability of each direction of the grid [E, A]. It has a lower limit (OUTLIER), because a view may be
        wrong."""
        azimuth, elevation, _ = spherical(percept.world_from_camera[:3, 3], center)
        displacement = np.stack([wrap(self.azimuth - azimuth), self.elevation - elevation], axis=-1)
        moved_mean, moved_std = self.transition(percept.latent_mean, displacement)
        score = log_density(self.goal_mean, moved_mean, np.sqrt(moved_std ** 2 + self.goal_std ** 2)).astype(np.float64)
        if self.direct:
            score = self._compared(score, percept, displacement, moved_mean.astype(np.float64))
        share = np.exp(score - score.max())
        share = (1 - OUTLIER) * share / share.sum() + OUTLIER / len(share)
        return np.log(share).reshape(GRID_ELEVATIONS, GRID_AZIMUTHS)

    def _compared(self, score: Array, percept: Percept, displacement: Array, moved_mean: Array) -> Array:
        """The log densities of the directions [N], less where they are near and the view is unlike the goal."""
        way = np.hypot(*displacement.T)  # near the pole, too, a change of azimuth rotates the image
        share = DIRECT * np.exp(-0.5 * (way / SAME_RAD) ** 2)
        near = share > LEAST_SHARE
        start, _ = self.transition(percept.latent_mean, np.zeros((1, 2)))
        moved = percept.latent_mean + moved_mean[near] - start
        std = np.hypot(SAME_STD, SAME_STD_PER_RAD * way[near])
        excess = ((self.goal_mean - moved) ** 2).mean(1) / std ** 2 - USUAL
        unlike = np.exp(-0.5 * len(self.goal_mean) * np.maximum(excess, 0.0))
        compared = score.copy()
        compared[near] += np.log1p(share[near] * (unlike - 1.0))
        return compared

    def grid(self, log_probability: Array) -> Array:
        """The same, because it is over the grid already."""
        return log_probability

    def views(self, log_probability: Array) -> Views | None:
        """None: nothing is known of a roll."""
        return None


class TurnLikeness:
    """The likeness by rotations, over the turn of the object, which may be symmetric, about the vertical."""

    def __init__(self, goal: Percept, symmetry: int = NONE):
        self.directions, self.symmetry = GoalDirections(goal), symmetry

    def of(self, percept: Percept, center: Array) -> Array:
        """Log probability of each turn [T]. It does not depend on where the object is."""
        return np.log(turn_probability(percept, self.symmetry))

    def grid(self, log_probability: Array) -> Array:
        """Log probabilities of the directions of the grid [E, A]."""
        return np.log(self.directions.of(np.exp(log_probability)))

    def views(self, log_probability: Array) -> Views | None:
        """None: an object that stands upright was seen by a camera that was."""
        return None


@dataclass(eq=False)
class Keyframe:
    """A view of the object that is kept, with what it says of the goal's direction (see `Likeness`)."""

    percept: Percept
    quality: float  # see CERTAIN
    range_m: float  # from the percept's scale
    log_likelihood: Array

    @property
    def eye(self) -> Array:
        """The position of the camera [3] (m, world)."""
        return self.percept.world_from_camera[:3, 3]


class GoalView:
    """The posterior over the directions from which one object looks as in the goal image.

    `goal` is the percept of this object in the goal image. If the object is symmetric, all directions from which it
    looks the same count as the same direction.
    """

    def __init__(self, config: BeliefConfig, likeness: Likeness, goal: Percept, symmetry: int = NONE):
        self.config, self.likeness, self.symmetry = config, likeness, symmetry
        self.equal_rad = turns_of(symmetry, GRID_AZIMUTHS)
        self.measured_range_m = REFERENCE_RANGE_M / goal.scale
        elevation, azimuth = viewing_grid()
        self.elevation, self.azimuth = (x.ravel() for x in np.meshgrid(elevation, azimuth, indexing="ij"))
        self.keyframes: list[Keyframe] = []
        self.views: Views | None = None  # how the goal's camera was turned, with the last posterior
        self.looks = Looks(symmetry)
        self.center = np.full(3, np.inf)  # last believed position of the object; none yet

    def seen(self, percept: Percept, center: Array) -> None:
        """Adds a view of the object, which is believed to be at `center` [3] (m, world).

        The view is dropped if a kept view from nearly the same direction is about as good.
        """
        if np.linalg.norm(center - self.center) > MOVED_M:
            self.center = np.array(center)
            for keyframe in self.keyframes:
                keyframe.log_likelihood = self.likeness.of(keyframe.percept, self.center)
        if self.config.pose == "last":
            self.keyframes = []
        eye = percept.world_from_camera[:3, 3]
        if percept.goal_agreement is not None:
            farther = percept.scale * self.measured_range_m / REFERENCE_RANGE_M * np.exp(percept.goal_log_larger or 0.0)
            self.looks.take(eye, self.center, percept.goal_agreement, farther, percept.goal_aside_rad or 0.0,
                            percept.goal_above_rad or 0.0)
        quality = percept.presence / (CERTAIN + percept.log_scale_std)
        near = [k for k in self.keyframes if _angle(k.eye, eye, self.center) < NEW_VIEW_RAD]
        if near and max(k.quality for k in near) * BETTER > quality:
            return
        self.keyframes = [k for k in self.keyframes if all(k is not other for other in near)]
        if len(self.keyframes) >= self.config.keyframes:
            self.keyframes.remove(min(self.keyframes, key=lambda k: k.quality))
        self.keyframes.append(Keyframe(percept, quality, REFERENCE_RANGE_M / percept.scale,
                                       self.likeness.of(percept, self.center)))

    def forget(self) -> None:
        """Drops all views: the object was moved, so they say nothing of how it is turned now."""
        self.keyframes, self.looks, self.center = [], Looks(self.symmetry), np.full(3, np.inf)

    def carried(self, move_m: Array, step: int) -> None:
        """Moves the kept views along with an object that drifts by `move_m` [3] (metres), as if they were one piece.
        Views from long before `step` are dropped, because the object may turn while it drifts."""
        self.center = self.center + move_m
        self.looks.carried(move_m)
        self.keyframes = [k for k in self.keyframes if k.percept.step > step - FRESH_STEPS]
        for keyframe in self.keyframes:
            camera = keyframe.percept.world_from_camera.copy()
            camera[:3, 3] += move_m
            keyframe.percept = replace(keyframe.percept, world_from_camera=camera)

    def here(self, percept: Percept) -> float:
        """Probability, by the present view alone, that the goal image was taken from about this direction."""
        eye = percept.world_from_camera[:3, 3]
        last = self.keyframes[-1]
        alone = last.log_likelihood if last.percept is percept else self.likeness.of(percept, self.center)
        share = np.exp(self.likeness.grid(alone)).ravel()
        return float(share[alike(eye, self.center, self.symmetry, rolled=self.views is not None).ravel()].sum())

    def log_posterior(self) -> Array | None:
        """Log probabilities of the directions of the grid, normalised [E, A]. None before the first view.

        The views are fused twice. The second time, views near the peak of the first result count more. What comparisons
        with the goal image say is multiplied.
        """
        if not self.keyframes:
            return None
        first = self._fused(np.ones(len(self.keyframes)))
        last = self._fused(1.0 + NEAR_WEIGHT * self._nearness(self.likeness.grid(first)))
        self.views = self.likeness.views(last)
        fused, compared = self.likeness.grid(last), self.looks.log_ratio(self.center)
        if compared is None:
            return fused
        share = (1 - UNSURE) * np.exp(fused) + UNSURE / fused.size
        total = np.log(share) + compared
        total -= total.max()
        return np.asarray(total - np.log(np.exp(total).sum()))

    def _fused(self, weights: Array) -> Array:
        # Views are not independent, and they share the error of the goal's percept: together they count as a few views.
        worth = min(self.config.view_worth, self.config.views_worth / weights.sum())
        # The prior is uniform in azimuth and elevation, because goals are drawn like this (paper, section 4.1).
        total = np.asarray(worth * sum(w * k.log_likelihood for w, k in zip(weights, self.keyframes, strict=True)))
        total -= total.max()
        return np.asarray(total - np.log(np.exp(total).sum()))

    def _nearness(self, log_posterior: Array) -> Array:
        """How near each kept view is to the likeliest direction, from 0 to 1 for the same direction [views]."""
        best = int(np.argmax(log_posterior))
        towards = [direction(self.azimuth[best] + equal, self.elevation[best]) for equal in self.equal_rad]
        cosines = np.array([max(unit(k.eye - self.center) @ each for each in towards) for k in self.keyframes])
        return np.exp(-0.5 * (np.arccos(np.clip(cosines, -1.0, 1.0)) / NEAR_RAD) ** 2)

    def range_m(self, log_posterior: Array) -> float:
        """Range (m) at which the goal image shows the object.

        It is the measured range, corrected by the error that the same networks make in views from about the goal's
        direction. With `belief.pose=last` it is not corrected. A view that agrees with the goal image tells it best.
        """
        if self.config.pose == "last":
            return self.measured_range_m
        compared_m = self.looks.range_m(self.center)
        if compared_m is not None:
            return compared_m
        weights = self._nearness(log_posterior)
        ratios = np.log([np.linalg.norm(k.eye - self.center) / k.range_m for k in self.keyframes])
        return float(self.measured_range_m * np.exp(weights @ ratios / (weights.sum() + SAME_SCALE)))


def _angle(a: Array, b: Array, center: Array) -> float:
    return float(np.arccos(np.clip(unit(a - center) @ unit(b - center), -1.0, 1.0)))
