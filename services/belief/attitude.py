"""How an object in any pose is turned, from percepts that tell rotations, and how a camera must be turned to see it as
in the goal image.

It is a posterior over rotations world_from_object: those of an object that stands upright (see `turn.py`), and those of
a grid over all rotations. Both count as equally likely before the first view. An upright one has far fewer to choose
from, so what looks upright is upright. Each view gives a mixture over rotations, and views are multiplied. The goal's
percept gives a mixture over rotations camera_from_object: turned with the object, they are rotations of the goal's
camera in the world.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from saccade.services.belief.turn import turns
from saccade.shared.bus.messages import Percept
from saccade.shared.world.geometry import direction, rotation_angle, unit, viewing_grid
from saccade.shared.world.symmetry import about_vertical, turns_of

Array = NDArray[np.float64]

GRID = 12_000  # rotations of the grid: about 0.19 rad from one to the next
UPRIGHT = 0.5  # chosen: probability that an object stands upright, before it was seen
OUTLIER = 0.05  # chosen: probability that what a view says of the rotation is wrong
BELL_RAD = 0.1  # chosen: what is added to the deviation of a percept, so that no rotation falls through the grid
DIRECTION_RAD = 0.1  # chosen: the same for the directions of the goal's camera
EQUAL_TURNS = 24  # that stand for all turns of an object which looks the same from all around
PAIRS = 200  # chosen: so many of the likeliest pairs of a rotation and a mode of the goal's percept are looked at
AROUND_RAD = 0.35  # chosen: rotations within this angle are told as one, by their mean
MOST_VIEWS = 6  # chosen: rotations of the goal's camera that are told
LEAST = 0.01  # chosen: a rotation of the goal's camera with a lower probability is not told


class Views(NamedTuple):
    """Rotations world_from_camera [V, 3, 3] from which an object looks as in the goal image, the likeliest first, and
    their log probabilities [V]."""

    rotations: Array
    log_probability: Array


@functools.lru_cache(maxsize=1)
def hypotheses() -> tuple[Array, Array]:
    """Rotations world_from_object [H, 3, 3], those about the vertical first, and their prior probabilities [H]."""
    upright = about_vertical(turns())
    rotations = np.concatenate([upright, rotation_grid(GRID)])
    prior = np.concatenate([np.full(len(upright), UPRIGHT / len(upright)), np.full(GRID, (1 - UPRIGHT) / GRID)])
    return rotations, prior


def rotation_grid(count: int) -> Array:
    """`count` rotations [count, 3, 3], spread evenly: a super-Fibonacci spiral (Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    x, y, z, w = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                     2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                     2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1).reshape(-1, 3, 3)


class PoseLikeness:
    """The likeness by rotations, over all rotations of the object (see `Likeness` in `pose.py`). `goal` is the object's
    percept in the goal image."""

    def __init__(self, goal: Percept, symmetry: int) -> None:
        assert goal.rotations is not None
        assert goal.camera_from_object is not None
        assert goal.log_probability is not None
        assert goal.deviation_rad is not None
        self.equal = about_vertical(turns_of(symmetry, EQUAL_TURNS))  # in the object's own frame
        self.ray = unit(goal.camera_from_object[:3, 3])  # in the goal's camera
        self.object_from_camera = np.asarray(goal.rotations).transpose(0, 2, 1)
        self.weights = np.exp(goal.log_probability)
        self.deviation_rad = np.hypot(goal.deviation_rad, DIRECTION_RAD)

    def of(self, percept: Percept, center: Array) -> Array:
        """How much likelier each rotation [H] is by one view alone, as a logarithm. It has a lower limit (OUTLIER)."""
        assert percept.rotations is not None  # only such percepts come here
        assert percept.log_probability is not None
        assert percept.deviation_rad is not None
        rotations, prior = hypotheses()
        told = np.einsum("ij,mjk,ekl->meil", percept.world_from_camera[:3, :3], percept.rotations, self.equal)
        deviation = np.hypot(percept.deviation_rad, BELL_RAD)
        share = np.zeros(len(rotations))
        for weight, equal, std in zip(np.exp(percept.log_probability), told, deviation, strict=True):
            share += weight / std ** 3 * np.exp(-0.5 * (_angles(rotations, equal) / std) ** 2).sum(1)
        return np.log((1 - OUTLIER) * share / max(float(prior @ share), 1e-12) + OUTLIER)

    def grid(self, log_probability: Array) -> Array:
        """Log probabilities of the directions of the grid [E, A], from which the goal's camera may have looked."""
        rotations, weights, deviation = self._pairs(log_probability)
        elevation, azimuth = viewing_grid()
        cells = direction(azimuth, elevation[:, None])
        cosine = cells.reshape(-1, 3) @ -(rotations @ self.ray).T
        # The normal distribution on a sphere (Fisher, 1953). Cells near the pole are smaller.
        share = np.exp((cosine - 1.0) / deviation ** 2) @ (weights / deviation ** 2)
        share = share.reshape(cells.shape[:2]) * np.cos(elevation)[:, None] + 1e-9
        return np.log(share / share.sum())

    def views(self, log_probability: Array) -> Views:
        """How the goal's camera was turned: peaks, each the mean of what is around it."""
        rotations, weights, _ = self._pairs(log_probability)
        left, means, shares = weights.copy(), list[Array](), list[float]()
        near = _angles(rotations, rotations) < AROUND_RAD
        while len(means) < MOST_VIEWS:
            mass = near @ left
            peak = int(np.argmax(mass))
            if mass[peak] < max(LEAST, 1e-6):
                break
            around = near[peak] & (left > 0)
            u, _, vt = np.linalg.svd(np.einsum("p,pij->ij", left * around, rotations))
            means.append(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
            shares.append(float(mass[peak]))
            left[rotation_angle(rotations, means[-1]) < 1.5 * AROUND_RAD] = 0.0
            left[around] = 0.0
        return Views(np.array(means).reshape(-1, 3, 3), np.log(np.array(shares)))

    def _pairs(self, log_probability: Array) -> tuple[Array, Array, Array]:
        """The likeliest rotations world_from_camera [P, 3, 3] of the goal's camera, their probabilities [P] and the
        deviations of their directions [P]."""
        rotations, prior = hypotheses()
        probability = prior * np.exp(log_probability - log_probability.max())
        best = np.sort(np.argpartition(-probability, PAIRS)[:PAIRS])
        joint = (probability[best, None] * self.weights).ravel()
        likeliest = np.argsort(-joint, kind="stable")[:PAIRS]
        which, mode = best[likeliest // len(self.weights)], likeliest % len(self.weights)
        chosen = joint[likeliest]
        return rotations[which] @ self.object_from_camera[mode], chosen / chosen.sum(), self.deviation_rad[mode]


def _angles(a: Array, b: Array) -> Array:
    """Angles [N, M] between rotations [N, 3, 3] and [M, 3, 3], as `rotation_angle` gives them, by one product."""
    return np.asarray(np.arccos(np.clip((a.reshape(-1, 9) @ b.reshape(-1, 9).T - 1.0) / 2.0, -1.0, 1.0)))
