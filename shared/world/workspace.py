"""Where a camera may be and how it moves there, in a scene that has a workspace: objects, obstacles, table and the
reach of what carries the camera.

This is the one check that the camera runs through nothing. Scenes without a workspace keep the rule of the paper
(`clip` in shared/world/task.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import Array, fibonacci_sphere

CLEARANCE_M = 0.06  # how far the camera stays from every surface: about the radius of its own body
STRIDE_M = 0.01  # a move is checked at points that are so near to one another
TABLE_THICK_M = 1.0  # a table reaches down so far: the camera does not go below it
SLACK_M = 1e-6  # numerical slack: a camera that was pushed onto the limit counts as allowed
_PUSHES = 8  # how often a position is pushed out of what it is in
_SHELLS_M = np.concatenate([np.arange(0.01, 0.3, 0.01), np.arange(0.3, 2.0, 0.05)])  # where room is searched
_DIRECTIONS = fibonacci_sphere(96)

Allowed = Callable[[Array], NDArray[np.bool_]]  # positions [N, 3] in metres -> whether each can be reached [N]


@dataclass(frozen=True)
class Boxes:
    """Boxes with centres [B, 3] (metres), rotations world_from_box [B, 3, 3] and sizes [B, 3] (metres)."""

    centers_m: Array
    rotations: Array
    sizes_m: Array

    def __len__(self) -> int:
        return len(self.centers_m)

    def local(self, points: ArrayLike) -> Array:
        """Points [..., 3] in the frames of all boxes [..., B, 3]."""
        apart = np.asarray(points, dtype=np.float64)[..., None, :] - self.centers_m
        return np.asarray(np.einsum("...bi,bij->...bj", apart, self.rotations))

    def distances_m(self, points: ArrayLike) -> Array:
        """Distances of points [..., 3] from the surfaces of all boxes [..., B]. They are negative inside."""
        beyond = np.abs(self.local(points)) - self.sizes_m / 2
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0))

    def outwards(self, point: ArrayLike, index: int) -> Array:
        """The direction [3] that leads from a point [3] away from one of the boxes on the shortest way."""
        local = self.local(point)[index]
        beyond = np.abs(local) - self.sizes_m[index] / 2
        sign = np.where(local < 0.0, -1.0, 1.0)
        away = np.maximum(beyond, 0.0) if (beyond > 0.0).any() else (beyond == beyond.max()).astype(np.float64)
        return np.asarray(self.rotations[index] @ (sign * away / np.linalg.norm(away)))

    def crossed(self, starts: ArrayLike, ends: ArrayLike) -> NDArray[np.bool_]:
        """Whether the segments between starts [..., 3] and ends [..., 3] meet the boxes [..., B]."""
        here, there = self.local(starts), self.local(ends)
        along = there - here
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        first, second = (-self.sizes_m / 2 - here) / along, (self.sizes_m / 2 - here) / along
        enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
        return np.asarray((enter <= leave) & (leave >= 0.0) & (enter <= 1.0))


def boxes_of(*groups: Boxes) -> Boxes:
    """All boxes of several groups."""
    return Boxes(np.concatenate([g.centers_m for g in groups]), np.concatenate([g.rotations for g in groups]),
                 np.concatenate([g.sizes_m for g in groups]))


NO_BOXES = Boxes(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class BoxReach:
    """The camera reaches a box between two corners [3] (metres)."""

    lower_m: Array
    upper_m: Array

    def nearest(self, points: ArrayLike) -> Array:
        """The position within reach that is nearest to each point [..., 3]."""
        return np.clip(np.asarray(points, dtype=np.float64), self.lower_m, self.upper_m)

    def bounds_m(self) -> tuple[Array, Array]:
        """The lowest and the highest corner [3] of a box around all that is within reach."""
        return self.lower_m, self.upper_m


@dataclass(frozen=True)
class ShellReach:
    """The camera reaches what is between two radii (metres) from the foot of an arm at `center_m` [3]."""

    center_m: Array
    inner_m: float
    outer_m: float

    def nearest(self, points: ArrayLike) -> Array:
        """The position within reach that is nearest to each point [..., 3]."""
        apart = np.asarray(points, dtype=np.float64) - self.center_m
        distance = np.linalg.norm(apart, axis=-1, keepdims=True)
        away = np.where(distance > 1e-9, apart / np.maximum(distance, 1e-9), (0.0, 0.0, 1.0))
        return np.asarray(self.center_m + away * np.clip(distance, self.inner_m, self.outer_m))

    def bounds_m(self) -> tuple[Array, Array]:
        """The lowest and the highest corner [3] of a box around all that is within reach."""
        return self.center_m - self.outer_m, self.center_m + self.outer_m


Reach = BoxReach | ShellReach


@dataclass(frozen=True)
class Space:
    """What the camera may do: it stays within reach, and CLEARANCE_M away from all boxes.

    `also` is a further limit that is given from outside, such as that of an arm's joints.
    """

    reach: Reach
    boxes: Boxes
    also: Allowed | None = None

    def room_m(self, points: ArrayLike) -> Array:
        """How much nearer to a box each point [..., 3] could be, in metres. It is negative where a point is too
        near."""
        points = np.asarray(points, dtype=np.float64)
        if not len(self.boxes):
            return np.full(points.shape[:-1], np.inf)
        return np.asarray(self.boxes.distances_m(points).min(-1) - CLEARANCE_M)

    def allows(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether the camera may be at each of the points [..., 3]."""
        points = np.asarray(points, dtype=np.float64)
        within = np.linalg.norm(self.reach.nearest(points) - points, axis=-1) <= SLACK_M
        free = within & (self.room_m(points) >= -SLACK_M)
        if self.also is None:
            return np.asarray(free)
        return np.asarray(free & np.asarray(self.also(points.reshape(-1, 3)), dtype=bool).reshape(free.shape))

    def free(self, start: ArrayLike, end: ArrayLike) -> bool:
        """Whether the camera can go straight from one point [3] to another."""
        return bool(self.allows(self._between(start, end)).all())

    def nearest(self, point: ArrayLike) -> Array:
        """An allowed position [3] as near to a point [3] as one is found. Raises SaccadeError if there is none."""
        pushed = self._pushed(np.asarray(point, dtype=np.float64))
        if self.allows(pushed):
            return pushed
        around = self.reach.nearest((pushed + _SHELLS_M[:, None, None] * _DIRECTIONS).reshape(-1, 3))
        around = around[self.allows(around)]
        if not len(around):
            raise SaccadeError("the camera finds no room in the workspace of the scene: make the workspace larger, or "
                               "take obstacles away")
        return np.asarray(around[np.argmin(np.linalg.norm(around - np.asarray(point), axis=1))])

    def moved(self, start: ArrayLike, end: ArrayLike) -> Array:
        """Where a camera at `start` [3] is after it was told to move to `end` [3].

        It goes straight. Where something is in the way, it slides along it, or stops. A camera at whose place something
        stands now gives way first.
        """
        here, there = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        if not self.allows(here):
            here = self.nearest(here)
            there = there + (here - np.asarray(start))
        points = self._between(here, there)
        if self.allows(points).all():
            return there
        stride = points[1] - points[0]
        for _ in points[1:]:
            on = self._pushed(here + stride)
            if np.linalg.norm(on - here) > 2 * np.linalg.norm(stride) or not self.allows(on):
                break
            here = on
        return here

    def _between(self, start: ArrayLike, end: ArrayLike) -> Array:
        here, there = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        count = int(np.ceil(np.linalg.norm(there - here) / STRIDE_M)) + 2
        return here + np.linspace(0.0, 1.0, count)[:, None] * (there - here)

    def _pushed(self, point: Array) -> Array:
        """A point [3] that is pushed out of the box that it is deepest in, some times, and back into reach."""
        point = self.reach.nearest(point)
        for _ in range(_PUSHES if len(self.boxes) else 0):
            rooms = self.boxes.distances_m(point) - CLEARANCE_M
            worst = int(np.argmin(rooms))
            if rooms[worst] >= -SLACK_M / 2:
                break
            point = self.reach.nearest(point - rooms[worst] * self.boxes.outwards(point, worst))
        return point
