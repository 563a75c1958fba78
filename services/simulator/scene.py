"""What a scene is: which objects are where, which view is the goal, what is around the table, and what happens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saccade.shared.wording import label_of
from saccade.shared.world.geometry import Array, pose, quaternion, rotation_of, yaw_rotation
from saccade.shared.world.workspace import TABLE_THICK_M, Boxes, Reach

EventKind = Literal["moved", "taken", "put_back", "pushed_over", "drifts"]
Quaternion = tuple[float, float, float, float]  # x, y, z, w
GREY = (150, 150, 150)


@dataclass(frozen=True)
class Placed:
    """An object on the table: the centre of its box [3] (metres, world), and how it is turned.

    An object that stands upright has only a yaw (radians). Otherwise `quaternion_xyzw` is the whole rotation
    world_from_object, and `yaw_rad` is 0. `instance` counts the objects of one name, from 1.
    """

    name: str
    center_m: NDArray[np.float64]
    yaw_rad: float
    instance: int = 1
    quaternion_xyzw: Quaternion | None = None

    @property
    def label(self) -> str:
        """What this one object is called: `soup_can`, `soup_can#2`."""
        return label_of(self.name, self.instance)

    @property
    def upright(self) -> bool:
        """Whether it is only turned about the vertical."""
        return self.quaternion_xyzw is None

    @property
    def rotation(self) -> Array:
        """The rotation world_from_object [3, 3]."""
        return yaw_rotation(self.yaw_rad) if self.quaternion_xyzw is None else rotation_of(self.quaternion_xyzw)

    @property
    def turned(self) -> float | Array:
        """As the renderer takes it: the yaw (radians), or the rotation [3, 3] of an object that is not upright."""
        return self.yaw_rad if self.quaternion_xyzw is None else self.rotation

    @property
    def world_from_object(self) -> Array:
        """Its pose [4, 4]. The origin of the object's frame is the centre of its box."""
        return pose(self.rotation, self.center_m)


def placed_at(name: str, instance: int, center_m: Array, rotation: Array) -> Placed:
    """An object at a centre [3] with any rotation world_from_object [3, 3]."""
    x, y, z, w = (float(value) for value in quaternion(rotation))
    return Placed(name, np.array(center_m, dtype=np.float64), 0.0, instance, (x, y, z, w))


@dataclass(frozen=True)
class Table:
    """The table: its extents along x and y (metres) and the height of its top (metres)."""

    size_xy_m: tuple[float, float]
    height_m: float = 0.0


PAPER_TABLE = Table((1.0, 1.0))


@dataclass(frozen=True)
class Obstacle:
    """A box that the camera may not enter and that hides what is behind it: centre [3] and size [3] in metres, yaw in
    radians, colour from 0 to 255."""

    center_m: NDArray[np.float64]
    size_m: NDArray[np.float64]
    yaw_rad: float = 0.0
    rgb: tuple[int, int, int] = GREY


@dataclass(frozen=True)
class Drift:
    """How an object goes on: by `velocity_m` [2] (metres a step, along x and y), or, if there is `about_xy_m` [2], by
    `turn_rad` a step about the vertical axis there.

    On an arc the object turns with it if `turns`. It stops after `steps`. It goes back and forth if it turns around
    after `back_after_steps`.
    """

    velocity_m: tuple[float, float] = (0.0, 0.0)
    about_xy_m: tuple[float, float] | None = None
    turn_rad: float = 0.0
    turns: bool = True
    steps: int | None = None
    back_after_steps: int | None = None

    def speed_m(self, start: Placed) -> float:
        """How far it moves in a step, metres."""
        if self.about_xy_m is None:
            return float(np.hypot(*self.velocity_m))
        return abs(self.turn_rad) * float(np.linalg.norm(start.center_m[:2] - np.array(self.about_xy_m)))

    def after(self, start: Placed, steps: int) -> Placed:
        """The object after a number of steps."""
        gone = steps if self.steps is None else min(steps, self.steps)
        if self.back_after_steps is not None:
            gone = self.back_after_steps - abs(gone % (2 * self.back_after_steps) - self.back_after_steps)
        center = start.center_m.copy()
        if self.about_xy_m is None:
            center[:2] += gone * np.array(self.velocity_m)
            return replace(start, center_m=center)
        turn, middle = yaw_rotation(gone * self.turn_rad), np.array(self.about_xy_m)
        center[:2] = middle + turn[:2, :2] @ (center[:2] - middle)
        if not self.turns:
            return replace(start, center_m=center)
        if start.upright:
            return replace(start, center_m=center, yaw_rad=start.yaw_rad + gone * self.turn_rad)
        return placed_at(start.name, start.instance, center, turn @ start.rotation)


@dataclass(frozen=True)
class Event:
    """Something that happens to an object during an episode, once.

    When: with `at_step`, or `after_in_view` steps after its object was first in view, or `after_previous` steps after
    the event before it in the list. What is moved, pushed over or put back is then at `to`; without `to` it is put back
    where it was.
    """

    kind: EventKind
    name: str
    instance: int = 1
    at_step: int | None = None
    after_in_view: int | None = None
    after_previous: int | None = None
    to: Placed | None = None
    drift: Drift | None = None

    @property
    def label(self) -> str:
        """The object that it happens to."""
        return label_of(self.name, self.instance)


@dataclass(frozen=True)
class Scene:
    """The world of one episode. `table_rgb` is from 0 to 255; `goal_world_from_camera` [4, 4] is the goal view's pose.

    With `target_absent` the target does not stand on the table. Its position is then used for the goal image only.
    In a scene with a `workspace` the camera may not run through anything (shared/world/workspace.py), it begins at
    `start_world_from_camera` [4, 4] if there is one, and there may be obstacles and another table.
    """

    id: str
    target: str
    table_rgb: tuple[int, int, int]
    objects: tuple[Placed, ...]
    goal_world_from_camera: NDArray[np.float64]
    target_absent: bool = False
    target_instance: int = 1
    start_world_from_camera: NDArray[np.float64] | None = None
    workspace: Reach | None = None
    table: Table | None = None
    obstacles: tuple[Obstacle, ...] = ()
    events: tuple[Event, ...] = ()

    @property
    def target_placed(self) -> Placed:
        """The target and its position. Of several instances it is the one that the goal image shows."""
        return next(p for p in self.objects if (p.name, p.instance) == (self.target, self.target_instance))

    @property
    def on_table(self) -> tuple[Placed, ...]:
        """The objects that stand on the table at first."""
        return tuple(p for p in self.objects if not (self.target_absent and p.name == self.target))

    @property
    def lying(self) -> bool:
        """Whether an object does not stand upright, or will not after an event."""
        return not all(p.upright for p in (*self.objects, *(e.to for e in self.events if e.to is not None)))

    @property
    def is_plain(self) -> bool:
        """Whether it is a scene as the paper's: each object stands upright, is there once, and nothing happens."""
        return self.workspace is None and not self.events and all(p.upright and p.instance == 1 for p in self.objects)


def surroundings(scene: Scene) -> Boxes:
    """The obstacles of a scene, and after them its table, as boxes."""
    table = scene.table or PAPER_TABLE
    centers = [o.center_m for o in scene.obstacles] + [np.array([0.0, 0.0, table.height_m - TABLE_THICK_M / 2])]
    sizes = [o.size_m for o in scene.obstacles] + [np.array([*table.size_xy_m, TABLE_THICK_M])]
    turned = [yaw_rotation(o.yaw_rad) for o in scene.obstacles] + [np.eye(3)]
    return Boxes(np.array(centers), np.array(turned), np.array(sizes))
