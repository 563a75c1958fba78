"""Variational free energy of one object at one step, term by term (paper, appendix A).

The filtering form: what was believed before the image is the prior of what is believed after it, so that F measures how
much each image still surprises, and falls as the belief sharpens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.model.latent import LatentTransition, kl_divergence
from saccade.shared.world.geometry import project, spherical, wrap

Array = NDArray[np.float64]

PIXEL_STD = 1.0  # of a crop's colours around their reconstruction: the paper's likelihood is the squared error
FLOOR = 1e-3


def identity_term(presence: float, prior: float) -> float:
    """KL[Q(i | o) || P(i)] of Bernoulli variables, nats; `prior`: that the object was expected in this view."""
    p, q = (float(np.clip(x, FLOOR, 1 - FLOOR)) for x in (presence, prior))
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


def gaussian_kl(mean: Array, covariance: Array, prior_mean: Array, prior_covariance: Array) -> float:
    """KL[N(mean, covariance) || N(prior)] in any dimension, nats."""
    precision = np.linalg.inv(prior_covariance)
    offset = prior_mean - mean
    logs = np.linalg.slogdet(prior_covariance)[1] - np.linalg.slogdet(covariance)[1]
    return float(0.5 * (np.trace(precision @ covariance) + offset @ precision @ offset - len(mean) + logs))


def position_term(before: tuple[Array, Array], after: tuple[Array, Array]) -> float:
    """KL[Q(t | o) || Q(t)] of the particle cloud's moments (mean [3], covariance [3, 3]) after and before the image."""
    noise = np.eye(3) * FLOOR ** 2
    return gaussian_kl(after[0], after[1] + noise, before[0], before[1] + noise)


def crop_term(percept: Percept, before: tuple[Array, Array]) -> float:
    """KL[Q(u | o) || P(u | t, v)] + KL[Q(sigma | o) || P(sigma | t, v)]: pixel and log scale as seen, against what the
    pinhole camera predicts from the belief before."""
    mean, covariance = before
    camera, focal = percept.world_from_camera, percept.intrinsics_px[0]
    pixel, depth = project(mean, camera, percept.intrinsics_px)
    if depth < 0.05:
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
    """KL[Q(p | o) || P(p | p_before, a)]: the latent as seen, against the one before moved by the camera's displacement
    around the object at `center` [3]; against a standard normal where there is none."""
    seen = percept.latent_mean, percept.latent_std
    if before is None:
        return float(kl_divergence(seen, (0.0, 1.0)))
    azimuth, elevation, _ = spherical(percept.world_from_camera[:3, 3], center)
    azimuth_0, elevation_0, _ = spherical(before.world_from_camera[:3, 3], center)
    displacement = np.array([[wrap(azimuth - azimuth_0), elevation - elevation_0]])
    mean, std = transition(before.latent_mean, displacement)
    return float(kl_divergence(seen, (mean[0], std[0])))


def likelihood_term(percept: Percept) -> float:
    """-log P(o_k | p) up to a constant: the reconstruction error of the crop."""
    return percept.reconstruction_error / (2 * PIXEL_STD ** 2)
