"""Variational free energy of one object at one step, term by term (paper, appendix A).

This is the filtering form: the belief before an image is the prior of the belief after it. So F measures how much each
image still surprises the agent, and it falls as the belief becomes more certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.model.latent import LatentTransition, kl_divergence
from saccade.shared.world.geometry import project, spherical, wrap

Array = NDArray[np.float64]

# They change only the free energy that is told, nothing that the agent does.
PIXEL_STD = 1.0  # from the paper: of a crop's colours around their reconstruction; its likelihood is the squared error
FLOOR = 1e-3  # chosen: smallest probability, and deviation (m) that is added to a particle cloud
NEAREST_M = 0.05  # derived: the near plane of the simulator's camera


def identity_term(presence: float, prior: float) -> float:
    """KL[Q(i | o) || P(i)] of two Bernoulli variables, in nats.

    `presence` is the probability that the object is in the image, `prior` that it was expected in this view.
    """
    p, q = (float(np.clip(x, FLOOR, 1 - FLOOR)) for x in (presence, prior))
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


def gaussian_kl(mean: Array, covariance: Array, prior_mean: Array, prior_covariance: Array) -> float:
    """KL[N(mean, covariance) || N(prior_mean, prior_covariance)] in nats, for means [D] and covariances [D, D]."""
    precision = np.linalg.inv(prior_covariance)
    offset = prior_mean - mean
    logs = np.linalg.slogdet(prior_covariance)[1] - np.linalg.slogdet(covariance)[1]
    return float(0.5 * (np.trace(precision @ covariance) + offset @ precision @ offset - len(mean) + logs))


def position_term(before: tuple[Array, Array], after: tuple[Array, Array]) -> float:
    """KL[Q(t | o) || Q(t)] in nats: the position after the image against the position before it.

    Both are moments of the particle cloud: mean [3] in m, covariance [3, 3] in m^2.
    """
    noise = np.eye(3) * FLOOR ** 2
    return gaussian_kl(after[0], after[1] + noise, before[0], before[1] + noise)


def crop_term(percept: Percept, before: tuple[Array, Array]) -> float:
    """KL[Q(u | o) || P(u | t, v)] + KL[Q(sigma | o) || P(sigma | t, v)] in nats, for pixel u and log scale sigma.

    Q is what was seen. P is what the pinhole camera predicts from the position before the image (mean [3] in m,
    covariance [3, 3] in m^2). The term is 0 if this position is less than 5 cm in front of the camera, or behind it.
    """
    mean, covariance = before
    camera, focal = percept.world_from_camera, percept.intrinsics_px[0]
    pixel, depth = project(mean, camera, percept.intrinsics_px)
    if depth < NEAREST_M:
        return 0.0
    range_m = float(np.linalg.norm(mean - camera[:3, 3]))
    ray = (mean - camera[:3, 3]) / range_m
    along = float(ray @ covariance @ ray)
    across = max((float(np.trace(covariance)) - along) / 2, 0.0)
    predicted = (percept.pixel_std ** 2 + across * (focal / depth) ** 2) * np.eye(2)
    where = gaussian_kl(percept.pixel, percept.pixel_std ** 2 * np.eye(2), pixel, predicted)
    spread = percept.log_scale_std ** 2
    scale = gaussian_kl(np.log([percept.scale]), np.array([[spread]]), np.log([0.40 / range_m]),
                        np.array([[spread + along / range_m ** 2]]))
    return where + scale


def pose_term(percept: Percept, before: Percept | None, center: Array, transition: LatentTransition) -> float:
    """KL[Q(p | o) || P(p | p_before, a)] in nats: the latent pose that was seen against the predicted one.

    The prediction is the latent pose of the percept `before`, moved by the camera's displacement around the object at
    `center` [3] (m, world). If there is no percept before, the prediction is a standard normal distribution.
    """
    seen = percept.latent_mean, percept.latent_std
    if before is None:
        return float(kl_divergence(seen, (0.0, 1.0)))
    azimuth, elevation, _ = spherical(percept.world_from_camera[:3, 3], center)
    azimuth_0, elevation_0, _ = spherical(before.world_from_camera[:3, 3], center)
    displacement = np.array([[wrap(azimuth - azimuth_0), elevation - elevation_0]])
    mean, std = transition(before.latent_mean, displacement)
    return float(kl_divergence(seen, (mean[0], std[0])))


def likelihood_term(percept: Percept) -> float:
    """-log P(o_k | p) in nats, up to a constant: the reconstruction error of the crop divided by 2 PIXEL_STD^2."""
    return percept.reconstruction_error / (2 * PIXEL_STD ** 2)
