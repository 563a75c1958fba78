"""Short ways for a camera through a workspace with obstacles: straight where that is free, otherwise over a lattice of
points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from saccade.shared.world.geometry import Array
from saccade.shared.world.workspace import ShellReach, Space

LATTICE_M = 0.05  # between neighbours of the lattice
MOST_POINTS = 60_000  # a larger workspace has a coarser lattice
_JOIN_M = 0.16  # an end of a way is joined to points of the lattice up to so far away
_NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)])


@dataclass(frozen=True)
class Lattice:
    """Allowed points [P, 3] of a space and the lengths of the free lines between neighbours."""

    points_m: Array
    lengths_m: csr_matrix


def lattice_of(space: Space) -> Lattice:
    """The lattice of a space."""
    lower, upper = space.reach.bounds_m()
    pitch = max(LATTICE_M, float(np.prod(upper - lower) / MOST_POINTS) ** (1 / 3))
    counts = np.maximum(2, np.ceil((upper - lower) / pitch).astype(int) + 1)
    grid = np.stack(np.meshgrid(*(np.linspace(lower[k], upper[k], counts[k]) for k in range(3)), indexing="ij"), -1)
    points = grid.reshape(-1, 3)
    room = space.room_m(points)
    if isinstance(space.reach, ShellReach):
        room = np.minimum(room, np.linalg.norm(points - space.reach.center_m, axis=1) - space.reach.inner_m)
    room[~space.allows(points)] = -np.inf
    room = room.reshape(counts)
    index = np.arange(len(points)).reshape(counts)
    starts, ends, lengths = [], [], []
    for shift in _NEIGHBOURS:
        here = tuple(slice(max(0, -s), counts[k] - max(0, s)) for k, s in enumerate(shift))
        there = tuple(slice(max(0, s), counts[k] - max(0, -s)) for k, s in enumerate(shift))
        apart = np.linalg.norm(grid[there] - grid[here], axis=-1)
        # Two balls without obstacles in them that meet hold the line between their centres
        joined = room[here] + room[there] > apart
        starts.append(index[here][joined])
        ends.append(index[there][joined])
        lengths.append(apart[joined])
    graph = csr_matrix((np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))),
                       shape=(len(points), len(points)))
    return Lattice(points, graph)


class Ways:
    """Short ways from one allowed position [3] to all others over the lattice of a space."""

    def __init__(self, space: Space, start: ArrayLike) -> None:
        self.space, self.start, self.lattice = space, np.asarray(start, dtype=np.float64), lattice_of(space)
        points = self.lattice.points_m
        joined = _joined(space, self.lattice, self.start)
        self._lengths, self._before = np.full(len(points), np.inf), np.full(len(points), -1)
        if len(joined):
            first = joined[np.argsort(np.linalg.norm(points[joined] - self.start, axis=1))]
            self._lengths, self._before, _ = dijkstra(self.lattice.lengths_m, directed=False, indices=first,
                                                      min_only=True, return_predecessors=True)

    def lengths_m(self, ends: ArrayLike) -> Array:
        """About how long the ways to positions [N, 3] are, in metres: at most _JOIN_M too short, because that is how
        far the lattice may begin from the start. Infinite where none is found."""
        reached = np.flatnonzero(np.isfinite(self._lengths))
        if not len(reached):
            return np.full(len(np.asarray(ends)), np.inf)
        apart, nearest = cKDTree(self.lattice.points_m[reached]).query(ends)
        return np.asarray(np.where(apart <= _JOIN_M, self._lengths[reached][nearest] + apart, np.inf))

    def to(self, ends: ArrayLike) -> tuple[Array, int] | None:
        """The corner points [K, 3] of a way to one of the allowed positions [G, 3], and the number of that position.
        None if no way is found."""
        goals = np.asarray(ends, dtype=np.float64).reshape(-1, 3)
        points = self.lattice.points_m
        best: tuple[float, int, int] | None = None
        for k, end in enumerate(goals):
            for point in _joined(self.space, self.lattice, end) if np.isfinite(self._lengths).any() else ():
                total = self._lengths[point] + float(np.linalg.norm(points[point] - end))
                if np.isfinite(total) and (best is None or total < best[0]):
                    best = total, k, int(point)
        if best is None:
            return None
        _, chosen, point = best
        way = [goals[chosen]]
        while point >= 0:
            way.append(points[point])
            point = int(self._before[point])
        return _shortened(self.space, np.array([self.start, *way[::-1]])), chosen


def find_way(space: Space, start: ArrayLike, goals: ArrayLike) -> tuple[Array, int] | None:
    """The corner points [K, 3] of a short way from an allowed position [3] to one of the allowed positions `goals`
    [G, 3], and the number of that goal. None if no way is found.

    A goal to which the straight line is free is preferred, the nearest first.
    """
    here, ends = np.asarray(start, dtype=np.float64), np.asarray(goals, dtype=np.float64).reshape(-1, 3)
    for k in np.argsort(np.linalg.norm(ends - here, axis=1)):
        if space.free(here, ends[k]):
            return np.stack([here, ends[k]]), int(k)
    return Ways(space, here).to(ends)


def _joined(space: Space, lattice: Lattice, point: Array) -> NDArray[np.intp]:
    """The points of the lattice that can be reached straight from a point [3]."""
    apart = np.linalg.norm(lattice.points_m - point, axis=1)
    near = np.flatnonzero(apart <= _JOIN_M)
    return np.array([k for k in near if space.free(point, lattice.points_m[k])], dtype=np.intp)


def _shortened(space: Space, way: Array) -> Array:
    """The way without the corners that can be left out."""
    corners, at = [way[0]], 0
    while at < len(way) - 1:
        at = next(k for k in range(len(way) - 1, at, -1) if k == at + 1 or space.free(way[at], way[k]))
        corners.append(way[at])
    return np.array(corners)
