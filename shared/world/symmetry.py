"""Rotational symmetry of an object about its up axis, which passes through the middle of its box.

A symmetry is a number: 1 for none, n for an object that looks the same after each n-th part of a turn, and CONTINUOUS
for one that looks the same from all around. As the measures of BOP do (Hodan et al., ECCV 2020), whatever is compared
up to a symmetry is compared with the nearest of all that look the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from saccade.shared.errors import told
from saccade.shared.world.geometry import Array

NONE, CONTINUOUS = 1, 0
MOST = 120  # what looks the same more often than every 3 degrees is continuous
STEPS = 360  # how many turns stand for all of a continuous symmetry


def symmetry_from(value: Any) -> int:
    """The symmetry that a card or an option says: "none", "continuous", or a number from 2 to 120. Raises ValueError if
    it says something else."""
    named = {"none": NONE, "continuous": CONTINUOUS}
    if isinstance(value, str) and value in named:
        return named[value]
    number = int(value) if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 4 else value
    if isinstance(number, int) and not isinstance(number, bool) and 2 <= number <= MOST:
        return number
    raise ValueError(f'symmetry is {told(value)}: write "none", "continuous", or a number from 2 to {MOST}, such as 4 '
                     "for a square box without a label")


def symmetry_value(symmetry: int) -> str | int:
    """What a card says of a symmetry."""
    return {NONE: "none", CONTINUOUS: "continuous"}.get(symmetry, symmetry)


def symmetry_words(symmetry: int) -> str:
    """How an object looks when it is turned about the vertical, in words."""
    part = {2: "half a turn", 3: "a third of a turn", 4: "a quarter turn"}.get(symmetry, f"1/{symmetry} of a turn")
    return {NONE: "looks different from each side", CONTINUOUS: "looks the same from all around"}.get(
        symmetry, f"looks the same after {part}")


def turns_of(symmetry: int, steps: int = STEPS) -> Array:
    """The turns (rad) about the up axis after which an object looks the same [N], the first of which is 0. For a
    continuous symmetry they are `steps` turns."""
    count = steps if symmetry == CONTINUOUS else symmetry
    return np.asarray(2 * np.pi / count * np.arange(count, dtype=np.float64))


def about_vertical(turns: ArrayLike) -> Array:
    """Rotations [N, 3, 3] by angles [N] (rad) about the vertical."""
    turns = np.asarray(turns, dtype=np.float64)
    rotations = np.zeros((len(turns), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(turns)
    rotations[:, 1, 0], rotations[:, 0, 1] = np.sin(turns), -np.sin(turns)
    rotations[:, 2, 2] = 1.0
    return rotations


def turned_about(center: ArrayLike, world_from_camera: ArrayLike, turns: ArrayLike) -> Array:
    """Camera poses [N, 4, 4]: one pose [4, 4], turned by angles [N] (rad) about the vertical through `center` [3]."""
    rotations, pose = about_vertical(turns), np.asarray(world_from_camera, dtype=np.float64)
    result = np.tile(np.eye(4), (len(rotations), 1, 1))
    result[:, :3, :3] = rotations @ pose[:3, :3]
    result[:, :3, 3] = np.asarray(center) + rotations @ (pose[:3, 3] - np.asarray(center))
    return result
