"""Where an object is: a particle filter over its position (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from filterpy.monte_carlo import systematic_resample
from numpy.typing import NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.world.geometry import IMAGE_SIZE_PX, REFERENCE_RANGE_M, pixel_rays, project

Array = NDArray[np.float64]

WORKSPACE_M = np.array([[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.5]])
VOLUME_M3 = float(np.prod(WORKSPACE_M[:, 1] - WORKSPACE_M[:, 0]))
MODEL_STD_M = 0.006  # chosen: what no network can know, the box's centre against what is seen of it
PAPER_ACROSS_M2, PAPER_ALONG_M2 = 0.020, 0.0969  # appendix D, as the published code has them
CORRELATION = 2.0  # chosen: successive views err alike, so their deviations count this much larger
OUTLIER = 0.05  # chosen: share of percepts that are of something else, anywhere in the workspace
FRESH_SHARE = 0.05  # chosen: share of the particles that are drawn anew from each percept, at least
VAGUE_M = 0.12  # chosen: a cloud wider than this says next to nothing
BORN_VAGUE = 0.7  # chosen: share of such a cloud that is drawn anew
MARGIN_PX = 30  # chosen: an object this near to the image's border need not be seen
MOST_LOG_ODDS = 8.0  # chosen: of presence and absence, so that a belief can still be changed by some views


@dataclass(frozen=True)
class Evidence:
    """A percept as a Gaussian in space: mean [3], covariance [3, 3], metres, world."""

    mean: Array
    covariance: Array
    range_m: float
    direction: Array


def evidence_of(percept: Percept, covariance: str = "calibrated") -> Evidence:
    """The Gaussian along the ray: sharp across it, as wide along it as the scale is uncertain; or of the paper's fixed
    covariance."""
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


@contextmanager
def _global_state(rng: np.random.Generator) -> Iterator[None]:
    """filterpy draws from NumPy's global state: lends it ours for the call."""
    before = np.random.get_state()
    np.random.seed(int(rng.integers(2 ** 32)))
    try:
        yield
    finally:
        np.random.set_state(before)


class PositionFilter:
    """Particles [N, 3] and weights [N] of one object."""

    def __init__(self, config: BeliefConfig, rng: np.random.Generator):
        self.config = config
        self.particles = rng.uniform(WORKSPACE_M[:, 0], WORKSPACE_M[:, 1], (config.particles, 3))
        self.weights = np.full(config.particles, 1.0 / config.particles)
        self.log_odds = 0.0  # that the object is in the scene at all

    @property
    def presence(self) -> float:
        """Probability that the object is in the scene."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.log_odds, -20, 20))))

    def seen(self, percept: Percept, rng: np.random.Generator) -> None:
        """Positive evidence: particles gain by their density under the percept's Gaussian; some are drawn from it, so
        that a lost object is found again, by two percepts that agree and not by a single wrong one."""
        evidence = evidence_of(percept, self.config.covariance)
        factor = np.linalg.cholesky(evidence.covariance)
        born = self.config.born
        if born and np.trace(self.moments()[1]) > VAGUE_M ** 2:
            born = BORN_VAGUE
        share = max(born, FRESH_SHARE) if born else 0.0
        fresh = rng.permutation(len(self.particles))[:int(share * len(self.particles))]
        drawn = evidence.mean + rng.standard_normal((len(fresh), 3)) @ factor.T
        inside = np.all((drawn > WORKSPACE_M[:, 0]) & (drawn < WORKSPACE_M[:, 1]), axis=1)
        self.particles[fresh] = np.where(inside[:, None], drawn, self.particles[fresh])
        likelihood = (1 - born) * (_density(self.particles, evidence, factor) + OUTLIER / VOLUME_M3)
        self.weights[fresh] = 1.0  # drawn from the percept itself, their share of the posterior is known:
        likelihood[fresh] = np.where(inside, born / VOLUME_M3 / max(len(fresh), 1), 0.0)
        self._reweigh(likelihood, rng)
        odds = percept.presence / max(1.0 - percept.presence, 1e-3)
        self.log_odds = min(self.log_odds + np.log(max(odds, 1e-3)), MOST_LOG_ODDS)

    def visible(self, camera: Array, intrinsics_px: Array, others: list[tuple[Evidence, float]]) -> NDArray[np.bool_]:
        """Which particles [N] are in view and not behind one of the `others` that are seen (with their radii, m)."""
        hide = behind if self.config.hidden == "outlines" else beyond_nearest
        return in_view(self.particles, camera, intrinsics_px) & ~hide(self.particles, camera[:3, 3], others)

    def expected(self, visible: NDArray[np.bool_]) -> float:
        """Probability that the object is seen, by the particles that are `visible` [N]."""
        return self.presence * float(self.weights[visible].sum())

    def missed(self, visible: NDArray[np.bool_], rng: np.random.Generator) -> None:
        """Negative evidence: the object is not seen, so the particles that are `visible` [N] lose."""
        share = float(self.weights[visible].sum())
        self._reweigh(np.where(visible, self.config.missed_weight, 1.0), rng)
        unseen = max(1.0 - share * (1.0 - self.config.missed_weight), 1e-3)
        self.log_odds = max(self.log_odds + np.log(unseen), -MOST_LOG_ODDS)

    def _reweigh(self, factors: Array, rng: np.random.Generator) -> None:
        weights = self.weights * factors
        self.weights = weights / weights.sum()
        if 1.0 / np.sum(self.weights ** 2) < self.config.resample_below * len(weights):
            with _global_state(rng):
                chosen = systematic_resample(self.weights)
            noise = rng.normal(0.0, self.config.jitter_m, self.particles.shape)
            self.particles = np.clip(self.particles[chosen] + noise, WORKSPACE_M[:, 0], WORKSPACE_M[:, 1])
            self.weights = np.full(len(weights), 1.0 / len(weights))

    def moments(self) -> tuple[Array, Array]:
        """Mean [3] and covariance [3, 3] of the cloud."""
        mean = self.weights @ self.particles
        centred = self.particles - mean
        return mean, (centred * self.weights[:, None]).T @ centred

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """`count` particles [count, 3] drawn by weight, evenly spread over the cloud."""
        places = (np.arange(count) + rng.random()) / count
        return self.particles[np.minimum(np.searchsorted(np.cumsum(self.weights), places), len(self.weights) - 1)]


def _density(points: Array, evidence: Evidence, factor: NDArray[np.floating]) -> Array:
    """Gaussian density [N], per cubic metre."""
    whitened = np.linalg.solve(factor, (points - evidence.mean).T)
    return np.exp(-0.5 * (whitened ** 2).sum(0)) / ((2 * np.pi) ** 1.5 * np.prod(np.diag(factor)))


def in_view(points: Array, camera: Array, intrinsics_px: Array) -> NDArray[np.bool_]:
    """Which points [N, 3] lie well inside the image."""
    pixels, depth = project(points, camera, intrinsics_px)
    inside = (pixels > MARGIN_PX) & (pixels < IMAGE_SIZE_PX - MARGIN_PX)
    return inside.all(-1) & (depth > 0.05)


def behind(points: Array, eye: Array, seen: list[tuple[Evidence, float]]) -> NDArray[np.bool_]:
    """Which points [N, 3] an object that is seen may hide from the eye [3]: farther, and within its outline."""
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
