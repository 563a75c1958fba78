"""The place that a goal message tells: where the camera may be, the table, and what stands around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.shared.world.geometry import Array, yaw_rotation
from saccade.shared.world.workspace import (
    NO_BOXES,
    TABLE_THICK_M,
    Boxes,
    BoxReach,
    Reach,
    ShellReach,
    Space,
    boxes_of,
)

HIGH_M = 0.3  # chosen: objects stand or lie on the table or in a heap: their middles are lower above it than this
SUNK_M = 0.01  # by which the table is lower where it hides something, so that what stands on it is not in it


class Told(Protocol):
    """The fields of a goal message about the place."""

    @property
    def workspace_m(self) -> NDArray[Any] | None: ...
    @property
    def shell_m(self) -> NDArray[Any] | None: ...
    @property
    def table_m(self) -> NDArray[Any] | None: ...
    @property
    def obstacle_centers_m(self) -> NDArray[Any] | None: ...
    @property
    def obstacle_sizes_m(self) -> NDArray[Any] | None: ...
    @property
    def obstacle_yaws_rad(self) -> NDArray[Any] | None: ...


@dataclass(frozen=True)
class Place:
    """Where the camera may be, the obstacles, and the table: its extents along x and y and the height of its top [3]
    (metres)."""

    reach: Reach
    walls: Boxes
    table_m: Array | None

    def space(self, objects: Boxes) -> Space:
        """What the camera may do among objects."""
        return Space(self.reach, boxes_of(objects, self.walls, self._table()))

    def extent_m(self, paper: Array) -> Array:
        """Where objects may be: from and to along each axis [3, 2]. Without a table it is that of the paper."""
        if self.table_m is None:
            return paper
        x, y, top = self.table_m
        return np.array([[-x / 2, x / 2], [-y / 2, y / 2], [top, top + HIGH_M]])

    def hides(self, eyes: ArrayLike, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether an obstacle or the table is between eyes [..., 3] and points [..., 3]."""
        between = boxes_of(self.walls, self._table(SUNK_M))
        if not len(between):
            return np.zeros(np.broadcast_shapes(np.shape(eyes), np.shape(points))[:-1], dtype=bool)
        return np.asarray(between.crossed(*np.broadcast_arrays(eyes, points)).any(-1))

    def _table(self, sunk_m: float = 0.0) -> Boxes:
        if self.table_m is None:
            return NO_BOXES
        x, y, top = self.table_m
        return Boxes(np.array([[0.0, 0.0, top - sunk_m - TABLE_THICK_M / 2]]), np.eye(3)[None],
                     np.array([[x, y, TABLE_THICK_M]]))


def place_of(told: Told | None) -> Place | None:
    """The place that a goal message tells. None if it tells no workspace: then the rule of the paper holds."""
    reach: Reach
    if told is None:
        return None
    if told.workspace_m is not None:
        reach = BoxReach(np.asarray(told.workspace_m[0]), np.asarray(told.workspace_m[1]))
    elif told.shell_m is not None:
        reach = ShellReach(np.asarray(told.shell_m[:3]), float(told.shell_m[3]), float(told.shell_m[4]))
    else:
        return None
    walls = NO_BOXES
    if told.obstacle_centers_m is not None and told.obstacle_sizes_m is not None:
        yaws = np.zeros(len(told.obstacle_centers_m)) if told.obstacle_yaws_rad is None else told.obstacle_yaws_rad
        walls = Boxes(np.asarray(told.obstacle_centers_m),
                      np.array([yaw_rotation(float(yaw)) for yaw in yaws]).reshape(-1, 3, 3),
                      np.asarray(told.obstacle_sizes_m))
    return Place(reach, walls, None if told.table_m is None else np.array(told.table_m, dtype=np.float64))
