"""Views of a symmetric target that look the same: the agent goes to the nearest one that it can reach, and what it has
found out at one of them holds for all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saccade.services.planner.place import Ground
from saccade.shared.world.geometry import Array, spherical
from saccade.shared.world.symmetry import CONTINUOUS, NONE, about_vertical, turned_about, turns_of


def nearest_eye(eye: Array, center: Array, symmetry: int, camera: Array, ground: Ground) -> Array:
    """The position [3] from which a target at `center` [3] looks as it does from `eye` [3] that is the nearest to the
    camera's pose [4, 4]. Positions that the camera cannot come near to are taken only if there are no others."""
    if symmetry == NONE:
        return eye
    eyes = center + about_vertical(turns_of(symmetry)) @ (eye - center)
    nearest_first = np.lexsort([np.linalg.norm(eyes - camera[:3, 3], axis=1), ground.is_blocked(eyes)])
    return np.asarray(eyes[nearest_first[0]])


@dataclass(frozen=True)
class Side:
    """The part of the directions around a target at `center` [3] that lies around the position `eye` [3]. Any view of a
    symmetric target looks like one from there."""

    center: Array
    symmetry: int
    eye: Array

    def eyes(self, eyes: Array) -> Array:
        """Positions [N, 3], turned to this side by what makes no difference."""
        if self.symmetry == NONE:
            return eyes
        across = eyes - self.center
        return self.center + np.einsum("nij,nj->ni", about_vertical(self._turns(eyes)), across)

    def pose(self, pose: Array) -> Array:
        """A camera pose [4, 4], turned to this side."""
        if self.symmetry == NONE:
            return pose
        return turned_about(self.center, pose, self._turns(pose[None, :3, 3]))[0]

    def _turns(self, eyes: Array) -> Array:
        aside = spherical(eyes, self.center)[0] - spherical(self.eye, self.center)[0]
        if self.symmetry == CONTINUOUS:
            return -aside
        part = 2 * np.pi / self.symmetry
        return -part * np.round(aside / part)
