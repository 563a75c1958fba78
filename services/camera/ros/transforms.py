"""The tree of coordinate frames (tf), with a bounded past for each transform."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.shared.ros.types import NANOSECONDS, RosError
from saccade.shared.world.geometry import Array, pose

HELD_NS = 10 * NANOSECONDS  # of the past of a transform
MOST_HELD, MOST_FRAMES = 20_000, 10_000
MOST_LINKS = 100  # from a frame to its root
MAX_GAP_NS = NANOSECONDS  # transforms are not interpolated across a longer gap, because the path there is unknown
HOLD_NS = NANOSECONDS // 10  # a transform also holds this long before the first and after the last
MAX_M = 1e6
UNIT = (0.9, 1.1)  # limits of a quaternion's length
MAX_NAME = 256


@dataclass
class _Link:
    """A frame's transforms to its parent: times in order, and for each x, y, z and the quaternion x, y, z, w. A fixed
    transform has one, for all times."""

    parent: str
    fixed: bool
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, time_ns: int, value: tuple[float, ...]) -> None:
        if self.fixed:
            self.times_ns, self.values = [time_ns], [value]
            return
        times, values = self.times_ns, self.values
        if times and time_ns < times[-1] - HELD_NS:  # the clock was set back: the past is another one
            times.clear()
            values.clear()
        k = bisect_left(times, time_ns)
        if k < len(times) and times[k] == time_ns:
            values[k] = value
            return
        times.insert(k, time_ns)
        values.insert(k, value)
        old = max(bisect_right(times, times[-1] - HELD_NS), len(times) - MOST_HELD)
        if 2 * old > len(times):  # not one by one, because the rest is moved each time
            del times[:old], values[:old]

    def at(self, time_ns: int) -> Array | None:
        """The transform [4, 4] from the frame to its parent. None if it is not known at this time."""
        times = self.times_ns
        if self.fixed:
            return _matrix(self.values[0])
        k = bisect_left(times, time_ns)
        if k < len(times) and times[k] == time_ns:
            return _matrix(self.values[k])
        if 0 < k < len(times) and times[k] - times[k - 1] <= MAX_GAP_NS:
            share = (time_ns - times[k - 1]) / (times[k] - times[k - 1])
            return _matrix(_between(self.values[k - 1], self.values[k], share))
        near = [i for i in (k - 1, k) if 0 <= i < len(times) and abs(times[i] - time_ns) <= HOLD_NS]
        return _matrix(self.values[min(near, key=lambda i: abs(times[i] - time_ns))]) if near else None


class TransformTree:
    """The frames of a robot and its world. Transforms are added in any order, and asked for at a time.

    Of each transform the last 10 seconds are held. Frames have one parent; if another one is told, it holds from then
    on. Names are those of ROS without a leading slash.
    """

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}

    def add(self, parent: str, child: str, time_ns: int, translation_m: Sequence[float], quaternion: Sequence[float], *,
            fixed: bool = False) -> None:
        """Adds the transform that maps coordinates in `child` to coordinates in `parent`; the quaternion is x, y, z, w.

        Raises RosError if no transform has such names or numbers, or if there are too many frames.
        """
        parent, child = name_of(parent), name_of(child)
        numbers = tuple(float(x) for x in (*translation_m, *quaternion))
        length = math.sqrt(sum(x * x for x in numbers[3:]))
        if not all(map(math.isfinite, numbers)) or max(map(abs, numbers[:3])) > MAX_M:
            raise RosError(f"the transform from {child} to {parent} is not finite")
        if not UNIT[0] <= length <= UNIT[1]:
            raise RosError(f"the quaternion from {child} to {parent} has length {length:.3f}, not 1")
        if parent == child:
            raise RosError(f"{child} is its own parent")
        link = self._links.get(child)
        if link is None and len(self._links) >= MOST_FRAMES:
            raise RosError(f"there are more than {MOST_FRAMES} frames")
        if link is None or link.parent != parent or link.fixed != fixed:
            link = self._links[child] = _Link(parent, fixed)
        link.add(time_ns, numbers)

    def fixed(self) -> TransformTree:
        """A tree of the fixed transforms alone."""
        tree = TransformTree()
        tree._links = {child: _Link(link.parent, True, list(link.times_ns), list(link.values))
                       for child, link in self._links.items() if link.fixed}
        return tree

    def knows(self, frame: str) -> bool:
        """Whether the frame is in the tree."""
        return frame in self._links or any(link.parent == frame for link in self._links.values())

    def parent(self, frame: str) -> str | None:
        """The parent of a frame. None for a root, and for a frame that is not known."""
        return self._links[frame].parent if frame in self._links else None

    def up(self, frame: str) -> list[str]:
        """The frame and its ancestors, the root last. It ends where frames go round in a circle."""
        path = [frame]
        while path[-1] in self._links and len(path) <= MOST_LINKS:
            if (parent := self._links[path[-1]].parent) in path:
                break
            path.append(parent)
        return path

    def path(self, world: str, camera: str) -> list[str] | None:
        """The frames from the world to the camera. None if they are not connected."""
        down, up = self.up(camera), self.up(world)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        return up[:up.index(common) + 1] + down[:down.index(common)][::-1]

    def at(self, world: str, camera: str, time_ns: int) -> Array | None:
        """The pose world_from_camera [4, 4] at a time. None if it is not known.

        Between two transforms the position is interpolated on the line and the rotation on the shortest arc.
        """
        path = self.path(world, camera)
        if path is None:
            return None
        result = np.eye(4)
        for one, other in pairwise(path):
            upwards = self.parent(one) == other
            step = self._links[one if upwards else other].at(time_ns)
            if step is None:
                return None
            result = result @ (_inverse(step) if upwards else step)
        return result

    def reaches(self, world: str, camera: str, time_ns: int) -> bool:
        """Whether all transforms between world and camera are known up to this time, so that waiting tells no more."""
        path = self.path(world, camera)
        return path is not None and all(link.fixed or link.times_ns[-1] >= time_ns for link in self._between(path))

    def moves(self, path: list[str]) -> bool:
        """Whether a transform along a path of frames can change."""
        return any(not link.fixed for link in self._between(path))

    def _between(self, path: list[str]) -> list[_Link]:
        return [self._links[one if self.parent(one) == other else other]
                for one, other in pairwise(path)]


def name_of(frame: str) -> str:
    """A frame's name without its leading slash. Raises RosError if it is empty or too long."""
    name = frame.removeprefix("/")
    if not name or len(name) > MAX_NAME or not name.isprintable():
        raise RosError("a frame has no name, or one that cannot be")
    return name


def _matrix(value: tuple[float, ...]) -> Array:
    return pose(Rotation.from_quat(value[3:]).as_matrix(), np.array(value[:3]))


def _inverse(transform: Array) -> Array:
    turned = transform[:3, :3].T
    return pose(turned, -turned @ transform[:3, 3])


def _between(one: tuple[float, ...], other: tuple[float, ...], share: float) -> tuple[float, ...]:
    a, b = np.array(one), np.array(other)
    turn = Rotation.from_quat(a[3:]).inv() * Rotation.from_quat(b[3:])  # the shorter of its two arcs
    turned = Rotation.from_quat(a[3:]) * Rotation.from_rotvec(share * turn.as_rotvec())
    return (*(a[:3] + share * (b[:3] - a[:3])), *turned.as_quat())
