"""Latent poses in NumPy: the parts of a CCN that belief needs, without PyTorch (paper, section 3.2 and table 7).

It computes the same as `Transition`, `log_density` and `kl_divergence` in `shared/model/generative_model.py`, which
training uses.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Weights

Array = NDArray[np.float32]
Gaussian = tuple[Array, Array]  # mean and standard deviation [..., L]

LEAK = 0.01  # slope of a leaky rectifier below 0
MIN_STD = 1e-3
LAYERS = (0, 2, 4, 6)
PREFIX = "ccn.transition."


class LatentTransition:
    """p(p' | p, a) of one object. Raises SaccadeError if its weights are missing or damaged, or are not those of a
    transition."""

    def __init__(self, weights: Weights, name: str):
        state, self.periodic = weights.state(name, PREFIX), weights.architecture == "default"
        try:
            self._layers = [(np.ascontiguousarray(state[f"layers.{i}.weight"].T), state[f"layers.{i}.bias"])
                            for i in LAYERS]
            fits = all(one[0].shape[1] == other[0].shape[0] for one, other in pairwise(self._layers))
            fits &= all(weight.ndim == 2 and bias.shape == weight.shape[1:] for weight, bias in self._layers)
            fits &= 2 * (self._layers[0][0].shape[0] - 2 - self.periodic) == self._layers[-1][0].shape[1]
        except (KeyError, ValueError, IndexError):
            fits = False
        if not fits:
            raise SaccadeError(f"weights {weights.folder / name} are of another architecture: train anew")

    def __call__(self, latent: Array, displacement: NDArray[np.float64]) -> Gaussian:
        """Moves a latent mean [L] by displacements (azimuth, elevation) [B, 2] in radians. Returns mean and standard
        deviation [B, L]."""
        moved = displacement.astype(np.float32)
        if self.periodic:
            moved = np.concatenate([np.sin(moved[:, :1]), np.cos(moved[:, :1]), moved[:, 1:]], axis=1)
        x = np.concatenate([np.broadcast_to(latent, (len(moved), len(latent))), moved], axis=1)
        *hidden, last = self._layers
        for weight, bias in hidden:
            x = x @ weight
            x += bias
            np.maximum(x, LEAK * x, out=x)
        mean, raw = np.split(x @ last[0] + last[1], 2, axis=1)
        return mean, np.logaddexp(0.0, raw) + MIN_STD


def log_density(x: Array, mean: Array, std: Array) -> Array:
    """log N(x; mean, std) of diagonal Gaussians [..., L], summed over the last axis."""
    return (-0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.9189385332046727).sum(-1)


def kl_divergence(q: Gaussian, p: tuple[Array | float, Array | float]) -> Array:
    """KL[q || p] of diagonal Gaussians [..., L] in nats, summed over the last axis."""
    ratio = q[1] / p[1]
    return (0.5 * (ratio ** 2 + ((q[0] - p[0]) / p[1]) ** 2 - 1.0) - np.log(ratio)).sum(-1)
