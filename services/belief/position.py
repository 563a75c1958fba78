"""Where an object is: a particle filter over its position (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from filterpy.monte_carlo import systematic_resample
from numpy.typing import NDArray

from saccade.services.belief.unseen import Unseen
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.world.geometry import IMAGE_SIZE_PX, REFERENCE_RANGE_M, pixel_rays, project
from saccade.shared.world.place import Place

Array = NDArray[np.float64]
Moments = tuple[Array, Array]  # mean [3] (m), covariance [3, 3] (m^2)

WORKSPACE_M = np.array([[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.5]])
MODEL_STD_M = 0.006  # chosen: deviation of the box's centre from the centre of what is seen, which no network can know
# Variances across and along the ray (paper, appendix D), with the values of the published code.
PAPER_ACROSS_M2, PAPER_ALONG_M2 = 0.020, 0.0969
CORRELATION = 2.0  # chosen: factor for a percept's deviations, because successive views have similar errors
OUTLIER = 0.05  # chosen: probability that a percept is of something else, anywhere in the workspace
FRESH_SHARE = 0.05  # chosen: at least this share of the particles is drawn anew from each percept
VAGUE_M = 0.12  # chosen: a particle cloud with a larger deviation than this says almost nothing
BORN_VAGUE = 0.7  # chosen: share of a cloud wider than VAGUE_M that is drawn anew from a percept
NEAREST_M = 0.05  # derived: the near plane of the simulator's camera
# Measured with the agent `sceneccn`: the centre of an object is told without bias if it is so many of its radii away
# from the border of the image, and so many of the radii of both from an object before it; told from a part alone, its
# deviations are these across its ray (m), and along it as a share of the range.
WHOLE, PART_M, PART_SHARE = 0.85, 0.04, 0.3
WHOLE_SHARE = 0.5  # chosen: of the variance of evidence, which allows for parts that are seen
OUTSIDE_M = 0.04  # chosen: a percept that is farther outside of the workspace than this is of a part, or wrong
MARGIN_PX = 30  # chosen: an object nearer than this to the image's border is not expected to be seen
HIDES = 0.5  # chosen: what is within this share of an object's radius of the line to its middle is wholly behind it
CARRIED_M = 0.003  # chosen: deviation that a drifting object's position gains in a step
UNSEEN = 1.5  # chosen: deviation of its speed, in units of the speed, while it is not seen
ELSEWHERE = 0.5  # chosen: share of the particles of an object that is gone that are drawn anew anywhere
LOST_LOG_ODDS = -1.0  # chosen: log odds that an object that is gone is in the scene
MOST_LOG_ODDS = 8.0  # chosen: limit of the log odds of presence, so that a few views can still change the belief


@dataclass(frozen=True)
class Evidence:
    """A percept as a Gaussian over the object's position (world frame): mean [3] in m, covariance [3, 3] in m^2.

    `range_m` is its distance from the camera, `direction` [3] the unit vector from the camera to it.
    """

    mean: Array
    covariance: Array
    range_m: float
    direction: Array


def evidence_of(percept: Percept, covariance: str = "calibrated") -> Evidence:
    """The Gaussian of a percept: narrow across its ray, and along its ray as wide as its scale is uncertain.

    With `covariance="paper"` the covariance is the paper's fixed one (appendix D).
    """
    camera = percept.world_from_camera
    ray = camera[:3, :3] @ pixel_rays(percept.pixel, percept.intrinsics_px)
    range_m = REFERENCE_RANGE_M / percept.scale
    across = CORRELATION * np.hypot(percept.pixel_std / percept.intrinsics_px[0] * range_m, MODEL_STD_M)
    along = CORRELATION * np.hypot(percept.log_scale_std * range_m, MODEL_STD_M)
    if covariance == "paper":
        across, along = np.sqrt(PAPER_ACROSS_M2), np.sqrt(PAPER_ALONG_M2)
    outer = np.outer(ray, ray)
    spread = across ** 2 * (np.eye(3) - outer) + along ** 2 * outer
    return Evidence(camera[:3, 3] + range_m * ray, spread, range_m, ray)


def of_whole(percept: Percept, radius_m: float, others: list[tuple[Evidence, float]],
             extent_m: Array = WORKSPACE_M) -> Evidence:
    """What a percept says of where the whole object is. It says less the more of the object lies beyond the border of
    the image, or behind one of the `others`, because the centre of what is seen is then somewhere else. Objects are
    within `extent_m` [3, 2]."""
    evidence = evidence_of(percept)
    radius_px = percept.intrinsics_px[0] * radius_m / evidence.range_m
    free = [float(np.minimum(percept.pixel, IMAGE_SIZE_PX - percept.pixel).min()) / radius_px]
    for other, other_radius_m in others:
        if other.range_m < evidence.range_m:
            apart = np.arccos(np.clip(evidence.direction @ other.direction, -1.0, 1.0))
            free.append(apart / (np.arctan(radius_m / evidence.range_m) + np.arctan(other_radius_m / other.range_m)))
    lacks = float(np.clip(1.0 - min(free) / WHOLE, 0.0, 1.0))
    if np.any((evidence.mean < extent_m[:, 0] - OUTSIDE_M) | (evidence.mean > extent_m[:, 1] + OUTSIDE_M)):
        lacks = 1.0
    outer = np.outer(evidence.direction, evidence.direction)
    wider = (PART_M * lacks) ** 2 * (np.eye(3) - outer) + (PART_SHARE * lacks * evidence.range_m) ** 2 * outer
    return replace(evidence, covariance=evidence.covariance * WHOLE_SHARE + wider)


@contextmanager
def _global_state(rng: np.random.Generator) -> Iterator[None]:
    """Seeds NumPy's global random state from `rng` while filterpy draws from it, and restores it afterwards."""
    before = np.random.get_state()
    np.random.seed(int(rng.integers(2 ** 32)))
    try:
        yield
    finally:
        np.random.set_state(before)


class PositionFilter:
    """A particle filter over the position of one object: particles [N, 3] (m, world) and weights [N].

    In a `place` that the goal message tells, objects are on its table, and its walls hide them. `presence` is the prior
    probability that the object is in the scene.
    """

    def __init__(self, config: BeliefConfig, rng: np.random.Generator, place: Place | None = None,
                 presence: float = 0.5):
        self.config, self.place = config, place
        self.extent_m = WORKSPACE_M if place is None else place.extent_m(WORKSPACE_M)
        self.volume_m3 = float(np.prod(self.extent_m[:, 1] - self.extent_m[:, 0]))
        self.particles = rng.uniform(self.extent_m[:, 0], self.extent_m[:, 1], (config.particles, 3))
        self.weights = np.full(config.particles, 1.0 / config.particles)
        self.prior = min(log_odds(presence), MOST_LOG_ODDS)
        self.log_odds = self.prior  # log odds that the object is in the scene
        self.unseen: Unseen | None = Unseen(self.extent_m)  # None once the object was seen

    @property
    def presence(self) -> float:
        """Probability that the object is in the scene."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.log_odds, -20, 20))))

    def seen(self, percept: Percept, rng: np.random.Generator) -> None:
        """Updates the particles with a percept that sees the object (positive evidence).

        Particles gain weight by their density under the percept's Gaussian. Some particles are drawn anew from this
        Gaussian, so that an object that was lost is found again: not by a single wrong percept, but by two that agree.
        """
        evidence = evidence_of(percept, self.config.covariance)
        factor = np.linalg.cholesky(evidence.covariance)
        born = self.config.born
        if born and np.trace(self.moments()[1]) > VAGUE_M ** 2:
            born = BORN_VAGUE
        share = max(born, FRESH_SHARE) if born else 0.0
        fresh = rng.permutation(len(self.particles))[:int(share * len(self.particles))]
        drawn = evidence.mean + rng.standard_normal((len(fresh), 3)) @ factor.T
        inside = np.all((drawn > self.extent_m[:, 0]) & (drawn < self.extent_m[:, 1]), axis=1)
        self.particles[fresh] = np.where(inside[:, None], drawn, self.particles[fresh])
        likelihood = (1 - born) * (_density(self.particles, evidence, factor) + OUTLIER / self.volume_m3)
        # The fresh particles were drawn from the percept itself, so their share of the posterior is known.
        self.weights[fresh] = 1.0
        likelihood[fresh] = np.where(inside, born / self.volume_m3 / max(len(fresh), 1), 0.0)
        self._reweigh(likelihood, rng)
        if self.unseen is not None:  # that it is not elsewhere says nothing against its being here
            self.log_odds, self.unseen = self.prior + self.unseen.log_overlooked(evidence.mean), None
        self.log_odds = min(self.log_odds + log_odds(percept.presence), MOST_LOG_ODDS)

    def visible(self, camera: Array, intrinsics_px: Array, others: list[tuple[Evidence, float]]) -> NDArray[np.bool_]:
        """Which particles [N] are inside the image and not hidden by one of the `others` or by a wall.

        `camera` is world_from_camera [4, 4]. `others` are the other objects that are seen, with their radii (m).
        """
        return self.clear(self.particles, camera, intrinsics_px, others)

    def clear(self, points: Array, camera: Array, intrinsics_px: Array, others: list[tuple[Evidence, float]],
              margin_px: float = MARGIN_PX) -> NDArray[np.bool_]:
        """The same of any points [N, 3] (m, world), at least `margin_px` from the image's border."""
        hide = behind if self.config.hidden == "outlines" else beyond_nearest
        visible = in_view(points, camera, intrinsics_px, margin_px) & ~hide(points, camera[:3, 3], others)
        return visible if self.place is None else visible & ~self.place.hides(camera[:3, 3], points)

    def expected(self, visible: NDArray[np.bool_]) -> float:
        """Probability that the object is seen in a view in which the particles `visible` [N] are visible."""
        return self.presence * float(self.weights[visible].sum())

    def missed(self, visible: NDArray[np.bool_], rng: np.random.Generator) -> None:
        """Updates the particles with an image in which the object is not seen (negative evidence).

        The particles that are `visible` [N] lose weight.
        """
        share = float(self.weights[visible].sum())
        self._reweigh(np.where(visible, self.config.missed_weight, 1.0), rng)
        unseen = max(1.0 - share * (1.0 - self.config.missed_weight), 1e-3)
        self.log_odds = max(self.log_odds + np.log(unseen), -MOST_LOG_ODDS)

    def not_found(self, camera: Array, intrinsics_px: Array, others: list[tuple[Evidence, float]]) -> None:
        """Updates the presence of an object that no image has shown so far. For the arguments see `visible`."""
        if self.unseen is not None:
            hiding = wholly_hiding(others)
            self.unseen.missed(self.clear(self.unseen.points, camera, intrinsics_px, hiding, margin_px=0.0))
            self.log_odds = self.prior + self.unseen.log_likelihood

    def carried(self, velocity_m: Array, seen: bool, rng: np.random.Generator) -> None:
        """Moves the particles as an object with this velocity [3] (metres a step) does in one step. If it was not
        `seen` in the last image, it may have stopped or turned back."""
        moved = self.particles + velocity_m + rng.normal(0.0, CARRIED_M, self.particles.shape)
        if not seen:
            moved += rng.normal(0.0, UNSEEN, (len(moved), 1)) * velocity_m
        self.particles = np.clip(moved, WORKSPACE_M[:, 0], WORKSPACE_M[:, 1])

    def placed(self, mean: Array, covariance: Array, rng: np.random.Generator) -> None:
        """Draws all particles anew: the object is now believed at `mean` [3] (m), with this covariance [3, 3] (m^2)."""
        self.unseen = None
        factor = np.linalg.cholesky(covariance + np.eye(3) * self.config.jitter_m ** 2)
        drawn = mean + rng.standard_normal(self.particles.shape) @ factor.T
        self.particles = np.clip(drawn, WORKSPACE_M[:, 0], WORKSPACE_M[:, 1])
        self.weights = np.full(len(self.particles), 1.0 / len(self.particles))

    def lost(self, rng: np.random.Generator) -> None:
        """The object is not where it was: it may be back there soon, or anywhere."""
        anywhere = rng.random(len(self.particles)) < ELSEWHERE
        drawn = rng.uniform(WORKSPACE_M[:, 0], WORKSPACE_M[:, 1], self.particles.shape)
        self.particles = np.where(anywhere[:, None], drawn, self.particles)
        self.weights = np.full(len(self.particles), 1.0 / len(self.particles))
        self.log_odds = min(self.log_odds, LOST_LOG_ODDS)

    def _reweigh(self, factors: Array, rng: np.random.Generator) -> None:
        weights = self.weights * factors
        self.weights = weights / weights.sum()
        if 1.0 / np.sum(self.weights ** 2) < self.config.resample_below * len(weights):
            with _global_state(rng):
                chosen = systematic_resample(self.weights)
            noise = rng.normal(0.0, self.config.jitter_m, self.particles.shape)
            self.particles = np.clip(self.particles[chosen] + noise, self.extent_m[:, 0], self.extent_m[:, 1])
            self.weights = np.full(len(weights), 1.0 / len(weights))

    def moments(self) -> Moments:
        """Mean and covariance of the particle cloud."""
        mean = self.weights @ self.particles
        centred = self.particles - mean
        return mean, (centred * self.weights[:, None]).T @ centred

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draws `count` particles [count, 3] (m) by weight, with systematic sampling."""
        places = (np.arange(count) + rng.random()) / count
        return self.particles[np.minimum(np.searchsorted(np.cumsum(self.weights), places), len(self.weights) - 1)]


def log_odds(probability: float) -> float:
    """Log odds of a probability, finite also where it is 0 or 1."""
    return float(np.log(max(probability / max(1.0 - probability, 1e-3), 1e-3)))


def _density(points: Array, evidence: Evidence, factor: NDArray[np.floating]) -> Array:
    """Density of the evidence's Gaussian at points [N, 3], per cubic metre [N]; `factor` is its Cholesky factor."""
    whitened = np.linalg.solve(factor, (points - evidence.mean).T)
    return np.exp(-0.5 * (whitened ** 2).sum(0)) / ((2 * np.pi) ** 1.5 * np.prod(np.diag(factor)))


def in_view(points: Array, camera: Array, intrinsics_px: Array, margin_px: float = MARGIN_PX) -> NDArray[np.bool_]:
    """Which points [N, 3] are in front of the camera and inside the image, at least `margin_px` from its border."""
    pixels, depth = project(points, camera, intrinsics_px)
    inside = (pixels > margin_px) & (pixels < IMAGE_SIZE_PX - margin_px)
    return inside.all(-1) & (depth > NEAREST_M)


def wholly_hiding(others: list[tuple[Evidence, float]]) -> list[tuple[Evidence, float]]:
    """The `others` with the radii (m) within which they hide an object wholly, and not just a part of it."""
    return [(evidence, HIDES * radius_m) for evidence, radius_m in others]


def behind(points: Array, eye: Array, seen: list[tuple[Evidence, float]]) -> NDArray[np.bool_]:
    """Which points [N, 3] may be hidden from the eye [3] by an object that is seen.

    These are the points that are farther away than the object and within its outline.
    """
    hidden = np.zeros(len(points), dtype=bool)
    offset = points - eye
    distance = np.linalg.norm(offset, axis=1)
    for evidence, radius_m in seen:
        cosine = offset @ evidence.direction / np.maximum(distance, 1e-9)
        widest = np.cos(np.arctan2(radius_m, evidence.range_m))
        hidden |= (cosine > widest) & (distance > evidence.range_m)
    return hidden


def beyond_nearest(points: Array, eye: Array, seen: list[tuple[Evidence, float]]) -> NDArray[np.bool_]:
    """Which points [N, 3] are farther from the eye [3] than the nearest object that is seen (the paper's cut-off)."""
    nearest = min((evidence.range_m for evidence, _ in seen), default=np.inf)
    return np.linalg.norm(points - eye, axis=1) > nearest
