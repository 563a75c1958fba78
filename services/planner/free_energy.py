"""Expected free energy G of candidate viewpoints, term by term (paper, equation 5).

All candidates are computed together. A test compares the result with a slow loop over the candidates.
"""

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

LOCALISED_M = 0.06  # chosen: if a position's deviation is smaller, the gain is computed from a Gaussian, not particles
ACROSS_STD_M = 0.012  # chosen: standard deviation of one percept across its ray, about as large as in perception
ALONG_SHARE = 0.06  # chosen: standard deviation of one percept along its ray, as a share of the range
ALONG_FLOOR_M = 0.01  # chosen: what is added to this deviation along the ray, which is also its lower limit
FOUND_STD_M = 0.03  # chosen: standard deviation of the position of an object that was just found
DETECTED = 0.9  # chosen: probability that an object in view is detected
FARTHEST_M = 1.2  # chosen: an object that is farther away than this is not recognised
NEAREST_M = 0.1  # chosen: an object that is nearer than this to the camera is not expected to be seen
LOOK_AT_STD_M = 0.02  # chosen: a look-at point this far from where the object is believed is as good
USED_VIEW = 0.85  # chosen: share of the image's half side within which an object counts as in view
HALF_VIEW_TANGENT = USED_VIEW * IMAGE_SIZE_PX / 2 / INTRINSICS_PX[0]
PARTICLES = 160  # chosen: about how many published particles the gain of an object not yet found is computed with
DOUBT = 0.1  # chosen: lower limit of the presence that weights an object's gain, so that it is looked for in any case


@dataclass(frozen=True)
class Terms:
    """The four terms of G for N candidates, each [N] in nats. G is their sum."""

    position: Array
    scale: Array
    pose: Array
    information: Array

    @property
    def total(self) -> Array:
        """G of each candidate [N], in nats."""
        return self.position + self.scale + self.pose + self.information


def expected_free_energy(eyes: Array, look_at: Array, beliefs: dict[str, Belief], preference: Preference | None,
                         information_weight: float) -> Terms:
    """The terms of G for candidates at `eyes` [N, 3] that look at `look_at` [N, 3] (m, world).

    Without a preference only the expected information gain counts.
    """
    zero = np.zeros(len(eyes))
    gain = sum((information_gain(eyes, look_at, belief) for belief in beliefs.values()), start=zero)
    information = -information_weight * gain
    if preference is None:
        return Terms(zero, zero, zero, information)
    belief = beliefs[preference.target]
    return Terms(look_at_cost(look_at, belief), scale_cost(eyes, look_at, preference), pose_cost(eyes, belief),
                 information)


def look_at_cost(look_at: Array, belief: Belief) -> Array:
    """-log Q(t = look-at point) for each candidate [N], in nats, up to a constant. Q is the Gaussian of the belief."""
    covariance = belief.covariance_m2 + np.eye(3) * LOOK_AT_STD_M ** 2
    offset = look_at - belief.mean_m
    return 0.5 * np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)


def scale_cost(eyes: Array, look_at: Array, preference: Preference) -> Array:
    """-log P(range | goal) for each candidate [N], in nats, up to a constant."""
    distance = np.linalg.norm(eyes - look_at, axis=1)
    return 0.5 * ((distance - preference.range_m) / preference.range_std_m) ** 2


def pose_cost(eyes: Array, belief: Belief) -> Array:
    """-log P(direction | goal) for each candidate [N], in nats, relative to the likeliest direction.

    P is the posterior over the directions from which the target looks as in the goal image. Without one the cost is 0.
    """
    if belief.goal_log_posterior is None:
        return np.zeros(len(eyes))
    azimuth, elevation, _ = spherical(eyes, belief.mean_m)
    posterior = belief.goal_log_posterior.astype(np.float64)
    return posterior.max() - bilinear(posterior, azimuth, elevation)


def bilinear(grid: Array, azimuth: Array, elevation: Array) -> Array:
    """Interpolates a viewing grid [E, A] between the centres of its cells, at azimuths and elevations [N] (radians).

    The azimuth is periodic. Beyond the first and the last elevation the value stays the same.
    """
    row = np.clip(elevation / (np.pi / 2) * GRID_ELEVATIONS - 0.5, 0, GRID_ELEVATIONS - 1)
    column = (azimuth + np.pi) / (2 * np.pi) * GRID_AZIMUTHS - 0.5
    r0, c0 = np.floor(row).astype(int), np.floor(column).astype(int)
    r1 = np.minimum(r0 + 1, GRID_ELEVATIONS - 1)
    fr, fc = row - r0, column - c0
    c0, c1 = c0 % GRID_AZIMUTHS, (c0 + 1) % GRID_AZIMUTHS
    return ((1 - fr) * ((1 - fc) * grid[r0, c0] + fc * grid[r0, c1])
            + fr * ((1 - fc) * grid[r1, c0] + fc * grid[r1, c1]))


def information_gain(eyes: Array, look_at: Array, belief: Belief) -> Array:
    """Expected decrease of the entropy of the object's position for each candidate [N], in nats.

    If the position is known well, it is computed from the position's Gaussian. Otherwise it is computed from the share
    of the particles that would come into view.
    """
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
    # If the object is found, the cloud shrinks to that of one percept. If not, the particles in view are removed.
    shrink = 0.5 * np.linalg.slogdet(belief.covariance_m2 / FOUND_STD_M ** 2)[1]
    return max(belief.presence, DOUBT) * (found * max(shrink, 0.0) - (1 - found) * np.log(np.maximum(1 - found, 1e-3)))


def _in_view(eyes: Array, forward: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points [..., 3] are inside the cone of the view along `forward` [..., 3] and near enough [...]."""
    offset = points - eyes
    ahead = (offset * forward).sum(-1)
    across = np.sqrt(np.maximum((offset ** 2).sum(-1) - ahead ** 2, 0.0))
    return (ahead > NEAREST_M) & (ahead < FARTHEST_M) & (across < HALF_VIEW_TANGENT * ahead)


def _gaussian_gain(eyes: Array, look_at: Array, mean: Array, covariance: Array) -> Array:
    """Entropy decrease [N], in nats, of a Gaussian position by one percept from each eye [N, 3].

    It is half the log ratio of the covariance's determinants before and after the percept, and 0 if the object is not
    in view.
    """
    offset = mean - eyes
    distance = np.linalg.norm(offset, axis=1)
    ray = offset / np.maximum(distance, 1e-9)[:, None]
    outer = ray[:, :, None] * ray[:, None, :]
    along = 1.0 / (ALONG_SHARE * distance + ALONG_FLOOR_M) ** 2
    precision = (np.eye(3) - outer) / ACROSS_STD_M ** 2 + outer * along[:, None, None]
    after = np.eye(3) + (covariance + np.eye(3) * 1e-6) @ precision
    seen = _in_view(eyes, unit(look_at - eyes), mean)
    return np.where(seen, 0.5 * np.linalg.slogdet(after)[1], 0.0)
