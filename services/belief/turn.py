"""How far an object is turned about the vertical, from percepts that tell rotations, and from where it would look like
the goal image.

Each view gives a mixture over the turn. The turn is the same in all views of an object that stands still, so they are
multiplied. The goal's percept gives a mixture over directions in the object's own frame; turned with the object, they
become directions in the world. A view that cannot decide has two turns. An object whose card says that it is symmetric
has each turn as often as it looks the same, with the same probability.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.world.geometry import viewing_grid, wrap
from saccade.shared.world.symmetry import NONE, turns_of

Array = NDArray[np.float64]

TURNS = 144  # cells of 2.5 degrees
OUTLIER = 0.05  # chosen: probability that what a view says of the turn is wrong
UPRIGHT_RAD = 0.25  # chosen: standard deviation of the tilt that a percept of an upright object has
STEEP = 0.2  # chosen: least cosine of an elevation, so that the azimuth stays defined near the pole


def turns() -> Array:
    """The turns at the centres of the cells [T], in radians."""
    return (np.arange(TURNS) + 0.5) * 2 * np.pi / TURNS - np.pi


def turn_probability(percept: Percept, symmetry: int = NONE) -> Array:
    """Probability of each turn about the vertical by one view alone [T]. It has a lower limit (OUTLIER). Turns after
    which an object with this symmetry looks the same have the same probability."""
    assert percept.rotations is not None  # only such percepts come here
    assert percept.log_probability is not None
    assert percept.deviation_rad is not None
    world = percept.world_from_camera[:3, :3] @ percept.rotations
    turn = np.arctan2(world[:, 1, 0] - world[:, 0, 1], world[:, 0, 0] + world[:, 1, 1])
    tilt = np.arccos(np.clip(world[:, 2, 2], -1.0, 1.0))
    weight = np.exp(percept.log_probability - 0.5 * (tilt / UPRIGHT_RAD) ** 2)
    equal = turns_of(symmetry, TURNS)[:, None, None]
    bells = _bells(wrap(turns() - turn[:, None] - equal), percept.deviation_rad[:, None]).sum(0)
    upright = weight @ (bells / bells.sum(1, keepdims=True))
    # What the modes of an object that is not upright have says nothing.
    share = upright + max(1.0 - float(upright.sum()), 0.0) / TURNS
    return (1 - OUTLIER) * share / share.sum() + OUTLIER / TURNS


class GoalDirections:
    """The directions from which an object would look as in the goal image, for each of its turns: a matrix of
    probabilities [E * A, T] whose columns sum to 1. `goal` is the object's percept in the goal image."""

    def __init__(self, goal: Percept) -> None:
        assert goal.rotations is not None
        assert goal.camera_from_object is not None
        assert goal.log_probability is not None
        assert goal.deviation_rad is not None
        towards = -goal.camera_from_object[:3, 3] / np.linalg.norm(goal.camera_from_object[:3, 3])
        own = np.einsum("mij,i->mj", goal.rotations, towards)  # in the object's frame
        azimuth, elevation = np.arctan2(own[:, 1], own[:, 0]), np.arcsin(np.clip(own[:, 2], -1.0, 1.0))
        rows, columns = viewing_grid()
        cells = np.zeros((len(rows), len(columns), TURNS))
        deviation = np.asarray(goal.deviation_rad, dtype=np.float64)
        for m, weight in enumerate(np.exp(goal.log_probability)):
            high = _bells(rows - elevation[m], deviation[m])
            around = _bells(wrap(columns[:, None] - azimuth[m] - turns()),
                            deviation[m] / max(float(np.cos(elevation[m])), STEEP))
            cells += weight * high[:, None, None] * around
        cells = cells.reshape(-1, TURNS) + 1e-9
        self._cells = cells / cells.sum(0)
        self.shape = len(rows), len(columns)

    def of(self, probability: Array) -> Array:
        """Probabilities of the directions of the viewing grid [E, A], for those of the turns [T]."""
        return (self._cells @ probability).reshape(self.shape)


def _bells(offset: Array, deviation: Array) -> Array:
    return np.exp(-0.5 * (offset / deviation) ** 2) / deviation
