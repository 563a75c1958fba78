"""From where an object would look like the goal: a posterior over its viewing hemisphere, fused over all views.

Each view's latent pose is moved by every displacement to the cells of a grid; a cell is as likely as the goal's latent
is under the moved one (paper, equations 2 and 5). Views at different places multiply; their disagreement makes the
posterior of a nearly symmetric object multi-modal, and new views decide between the modes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.model.latent import LatentTransition, log_density
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

Array = NDArray[np.float64]

OUTLIER = 0.05  # chosen: share of views whose latent says nothing
NEW_VIEW_RAD = 0.08  # chosen: a view this near to a kept one adds nothing, a little more than a cell of the grid
BETTER = 1.2  # chosen: unless its quality is higher by this factor
CERTAIN = 0.03  # chosen: deviation of a log scale that counts as certain, in the quality of a view
HERE_RAD = 0.25  # chosen: directions that would pass for the goal's, half of what the task allows
TURNED_RAD = 0.5  # derived: the task's tolerance, for the turn of the image near the pole
NEAR_RAD = 0.35  # chosen: views this near to the goal's direction say more about it
NEAR_WEIGHT = 5.0  # chosen: by so much, at most
SAME_SCALE = 0.3  # chosen: weight of the prior that the goal's range is as measured, against one near view
MOVED_M = 0.01  # chosen: when the object is believed elsewhere by this much, displacements are measured again


@dataclass(eq=False)
class Keyframe:
    """A view that is kept: from where, what the latent was, and its log likelihood over the grid [E, A]."""

    eye: Array
    mean: NDArray[np.float32]
    quality: float
    range_m: float  # as the percept has it
    log_likelihood: Array


class GoalView:
    """The posterior of one object."""

    def __init__(self, config: BeliefConfig, transition: LatentTransition, goal: Percept):
        self.config, self.transition = config, transition
        self.goal_mean = np.array(goal.latent_mean)
        self.goal_std = np.array(goal.latent_std)
        self.measured_range_m = REFERENCE_RANGE_M / goal.scale
        elevation, azimuth = viewing_grid()
        self.elevation, self.azimuth = (x.ravel() for x in np.meshgrid(elevation, azimuth, indexing="ij"))
        self.prior = np.zeros((GRID_ELEVATIONS, GRID_AZIMUTHS))  # even in elevation, as goals are drawn (section 4.1)
        self.keyframes: list[Keyframe] = []
        self.center = np.full(3, np.inf)  # where the object was believed last: nowhere yet

    def seen(self, percept: Percept, center: Array) -> None:
        """Adds a view of the object, believed at `center` [3], unless one like it is kept."""
        if np.linalg.norm(center - self.center) > MOVED_M:
            self.center = np.array(center)
            for keyframe in self.keyframes:
                keyframe.log_likelihood = self._likelihood(keyframe.eye, keyframe.mean)
        if self.config.pose == "last":
            self.keyframes = []
        eye = percept.world_from_camera[:3, 3]
        quality = percept.presence / (CERTAIN + percept.log_scale_std)
        near = [k for k in self.keyframes if _angle(k.eye, eye, self.center) < NEW_VIEW_RAD]
        if near and max(k.quality for k in near) * BETTER > quality:
            return
        self.keyframes = [k for k in self.keyframes if all(k is not other for other in near)]
        if len(self.keyframes) >= self.config.keyframes:
            self.keyframes.remove(min(self.keyframes, key=lambda k: k.quality))
        mean = np.array(percept.latent_mean)
        self.keyframes.append(Keyframe(np.array(eye), mean, quality, REFERENCE_RANGE_M / percept.scale,
                                       self._likelihood(eye, mean)))

    def here(self, percept: Percept) -> float:
        """Share of the present view's say that falls to the directions around its own."""
        eye = percept.world_from_camera[:3, 3]
        mean = percept.latent_mean
        last = self.keyframes[-1]
        kept = np.array_equal(last.eye, eye) and np.array_equal(last.mean, mean)
        share = np.exp(last.log_likelihood if kept else self._likelihood(eye, mean)).ravel()
        near = direction(self.azimuth, self.elevation) @ unit(eye - self.center) > np.cos(HERE_RAD)
        # near the pole the azimuth turns the image: only what is turned as seen from here counts
        azimuth, elevation, _ = spherical(eye, self.center)
        turned = np.abs(wrap(self.azimuth - azimuth)) < HERE_RAD / max(float(np.cos(elevation)), HERE_RAD)
        upright = (elevation < np.pi / 2 - 3 * HERE_RAD) | (np.abs(wrap(self.azimuth - azimuth)) < TURNED_RAD)
        return float(share[near & turned & upright].sum())

    def _likelihood(self, eye: Array, mean: NDArray[np.float32]) -> Array:
        """log of the share of each cell in one view's say [E, A], with a floor for views that are wrong."""
        azimuth, elevation, _ = spherical(eye, self.center)
        displacement = np.stack([wrap(self.azimuth - azimuth), self.elevation - elevation], axis=-1)
        moved_mean, moved_std = self.transition(mean, displacement)
        score = log_density(self.goal_mean, moved_mean, np.sqrt(moved_std ** 2 + self.goal_std ** 2)).astype(np.float64)
        share = np.exp(score - score.max())
        share = (1 - OUTLIER) * share / share.sum() + OUTLIER / len(share)
        return np.log(share).reshape(GRID_ELEVATIONS, GRID_AZIMUTHS)

    def log_posterior(self) -> Array | None:
        """Normalised log probabilities [E, A]; None before the first view."""
        if not self.keyframes:
            return None
        first = self._fuse(np.ones(len(self.keyframes)))
        return self._fuse(1.0 + NEAR_WEIGHT * self._nearness(first))

    def _fuse(self, weights: Array) -> Array:
        # views are not independent, and they share the goal's own error: together they count for a few at most
        worth = min(self.config.view_worth, self.config.views_worth / weights.sum())
        total = self.prior + worth * sum(w * k.log_likelihood for w, k in zip(weights, self.keyframes, strict=True))
        total -= total.max()
        return total - np.log(np.exp(total).sum())

    def _nearness(self, log_posterior: Array) -> Array:
        """How near each kept view is to the likeliest direction [views], 1 for the same."""
        best = int(np.argmax(log_posterior))
        towards = direction(self.azimuth[best], self.elevation[best])
        cosines = np.array([unit(k.eye - self.center) @ towards for k in self.keyframes])
        return np.exp(-0.5 * (np.arccos(np.clip(cosines, -1.0, 1.0)) / NEAR_RAD) ** 2)

    def range_m(self, log_posterior: Array) -> float:
        """The goal's range: as measured, corrected by what the same networks get wrong on views from about there."""
        if self.config.pose == "last":
            return self.measured_range_m
        weights = self._nearness(log_posterior)
        ratios = np.log([np.linalg.norm(k.eye - self.center) / k.range_m for k in self.keyframes])
        return float(self.measured_range_m * np.exp(weights @ ratios / (weights.sum() + SAME_SCALE)))


def _angle(a: Array, b: Array, center: Array) -> float:
    return float(np.arccos(np.clip(unit(a - center) @ unit(b - center), -1.0, 1.0)))
