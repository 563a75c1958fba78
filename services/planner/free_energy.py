"""Expected free energy of candidate viewpoints, term by term (paper, equation 5). Batched; its slow twin is a loop in
the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.services.planner.goal import Preference
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import (
    GRID_AZIMUTHS,
    GRID_ELEVATIONS,
    IMAGE_SIZE_PX,
    INTRINSICS_PX,
    Array,
    spherical,
    unit,
)

LOCALISED_M = 0.06  # chosen: deviation below which an object counts as a point
ACROSS_STD_M = 0.012  # chosen: deviation of one percept across its ray, about what perception has
ALONG_SHARE = 0.06  # chosen: the same along its ray, as a share of the range
ALONG_FLOOR_M = 0.01  # chosen: and at least this
FOUND_STD_M = 0.03  # chosen: deviation of the cloud of an object that was just found
DETECTED = 0.9  # chosen: probability that an object in view is seen
FARTHEST_M = 1.2  # chosen: beyond it nothing is recognised
USED_VIEW = 0.85  # chosen: share of the image's half side within which an object counts as in view
HALF_VIEW_TANGENT = USED_VIEW * IMAGE_SIZE_PX / 2 / INTRINSICS_PX[0]
PARTICLES = 160  # chosen: of those published, that the information gain of an object not yet found is measured with
DOUBT = 0.1  # chosen: an object believed absent is still worth so much of a look


@dataclass(frozen=True)
class Terms:
    """The four terms of G for N candidates [N] each, in nats: G is their sum."""

    position: Array
    scale: Array
    pose: Array
    information: Array

    @property
    def total(self) -> Array:
        """G [N]."""
        return self.position + self.scale + self.pose + self.information


def expected_free_energy(eyes: Array, look_at: Array, beliefs: dict[str, Belief], preference: Preference | None,
                         information_weight: float) -> Terms:
    """G of candidates at `eyes` [N, 3] that look at `look_at` [N, 3]. Without a preference only information counts."""
    zero = np.zeros(len(eyes))
    gain = sum((information_gain(eyes, look_at, belief) for belief in beliefs.values()), start=zero)
    information = -information_weight * gain
    if preference is None:
        return Terms(zero, zero, zero, information)
    belief = beliefs[preference.target]
    return Terms(look_at_cost(look_at, belief), scale_cost(eyes, look_at, preference), pose_cost(eyes, belief),
                 information)


def look_at_cost(look_at: Array, belief: Belief) -> Array:
    """-log Q(t = look-at point) under the target's Gaussian belief [N]."""
    covariance = belief.covariance_m2 + np.eye(3) * 0.02 ** 2
    offset = look_at - belief.mean_m
    return 0.5 * np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)


def scale_cost(eyes: Array, look_at: Array, preference: Preference) -> Array:
    """-log P(range | goal) [N], up to a constant."""
    distance = np.linalg.norm(eyes - look_at, axis=1)
    return 0.5 * ((distance - preference.range_m) / preference.range_std_m) ** 2


def pose_cost(eyes: Array, belief: Belief) -> Array:
    """-log posterior that the target looks from here as in the goal [N], relative to the likeliest direction."""
    if belief.goal_log_posterior is None:
        return np.zeros(len(eyes))
    azimuth, elevation, _ = spherical(eyes, belief.mean_m)
    posterior = belief.goal_log_posterior.astype(np.float64)
    return posterior.max() - bilinear(posterior, azimuth, elevation)


def bilinear(grid: Array, azimuth: Array, elevation: Array) -> Array:
    """Values [N] of a viewing grid [E, A] between its cells' centres; azimuth wraps, elevation ends."""
    row = np.clip(elevation / (np.pi / 2) * GRID_ELEVATIONS - 0.5, 0, GRID_ELEVATIONS - 1)
    column = (azimuth + np.pi) / (2 * np.pi) * GRID_AZIMUTHS - 0.5
    r0, c0 = np.floor(row).astype(int), np.floor(column).astype(int)
    r1 = np.minimum(r0 + 1, GRID_ELEVATIONS - 1)
    fr, fc = row - r0, column - c0
    c0, c1 = c0 % GRID_AZIMUTHS, (c0 + 1) % GRID_AZIMUTHS
    return ((1 - fr) * ((1 - fc) * grid[r0, c0] + fc * grid[r0, c1])
            + fr * ((1 - fc) * grid[r1, c0] + fc * grid[r1, c1]))


def information_gain(eyes: Array, look_at: Array, belief: Belief) -> Array:
    """Expected drop of the position's entropy [N], nats: as a Gaussian where the object is known to stand somewhere,
    from the share of particles that would come into view where it is not."""
    spread = float(np.sqrt(np.trace(belief.covariance_m2)))
    if spread < LOCALISED_M:
        return _gaussian_gain(eyes, look_at, belief.mean_m, belief.covariance_m2)
    particles = belief.particles_m[:: max(1, len(belief.particles_m) // PARTICLES)].astype(np.float64)
    share = np.zeros(len(eyes))
    forward = unit(look_at - eyes)
    for start in range(0, len(eyes), 1000):
        rows = slice(start, start + 1000)
        share[rows] = _in_view(eyes[rows, None], forward[rows, None], particles[None]).mean(1)
    found = DETECTED * share
    # finding it shrinks the cloud to one percept; not finding it removes the share that was looked at
    shrink = 0.5 * np.linalg.slogdet(belief.covariance_m2 / FOUND_STD_M ** 2)[1]
    return max(belief.presence, DOUBT) * (found * max(shrink, 0.0) - (1 - found) * np.log(np.maximum(1 - found, 1e-3)))


def _in_view(eyes: Array, forward: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points are inside the view's cone and near enough; broadcast over leading axes."""
    offset = points - eyes
    ahead = (offset * forward).sum(-1)
    across = np.sqrt(np.maximum((offset ** 2).sum(-1) - ahead ** 2, 0.0))
    return (ahead > 0.1) & (ahead < FARTHEST_M) & (across < HALF_VIEW_TANGENT * ahead)


def _gaussian_gain(eyes: Array, look_at: Array, mean: Array, covariance: Array) -> Array:
    """Half the log ratio of the determinants before and after one percept from each eye [N]."""
    offset = mean - eyes
    distance = np.linalg.norm(offset, axis=1)
    ray = offset / np.maximum(distance, 1e-9)[:, None]
    outer = ray[:, :, None] * ray[:, None, :]
    along = 1.0 / (ALONG_SHARE * distance + ALONG_FLOOR_M) ** 2
    precision = (np.eye(3) - outer) / ACROSS_STD_M ** 2 + outer * along[:, None, None]
    after = np.eye(3) + (covariance + np.eye(3) * 1e-6) @ precision
    seen = _in_view(eyes, unit(look_at - eyes), mean)
    return np.where(seen, 0.5 * np.linalg.slogdet(after)[1], 0.0)
