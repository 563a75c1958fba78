"""Short steps towards a camera pose, around spheres that the camera may not enter.

The planner passes the spheres that it believes in, the oracle the true ones.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from saccade.shared.world.geometry import Array, euler_xyz, fibonacci_sphere, unit
from saccade.shared.world.task import ACTION_LIMIT, LOWER_M, UPPER_M, Spheres, clip

STEP_M = 0.05  # from the paper
_SLACK_M = 1e-6  # numerical slack: a camera that was pushed onto the surface of a sphere counts as outside
# Derived: corners of a detour lie on a sphere that is larger by this factor. Then the line between two neighbours of
# the 48 corners does not cut the original sphere.
_DETOUR = 1.12
_CORNERS = fibonacci_sphere(48)
_SHELLS_M = np.arange(0.01, 0.5, 0.01)  # chosen: distances at which a position outside all spheres is searched
_SHARES = np.linspace(0.05, 0.95, 19)  # chosen: shares of the way from a position to the centre of a sphere
_ASIDE_M = (0.02, 0.05)  # chosen: how far from both ends a detour may begin
_WORTH_M = 0.01  # chosen: a long move into a sphere is made only if it comes nearer to the goal by more than this


def step_towards(world_from_camera: ArrayLike, goal_world_from_camera: ArrayLike, spheres: Spheres,
                 step_m: float = STEP_M) -> tuple[Array, Array]:
    """The next action (translation [3] in m, rotation [3] in rad) from a camera pose [4, 4] towards a goal pose [4, 4].

    The camera moves at most `step_m` along the shortest path that was found around the spheres. So the remaining path
    becomes shorter with every step, and the camera never gets stuck. A goal may lie inside a sphere; only then the last
    move may be longer (see `reach`). The camera turns along the great arc, at most 0.5 rad about each axis.
    """
    camera = np.asarray(world_from_camera, dtype=np.float64)
    goal = np.asarray(goal_world_from_camera, dtype=np.float64)
    here, there = camera[:3, 3], goal[:3, 3]
    way = way_around(here, there, spheres)
    gap = np.linalg.norm(way[-1] - there)  # 0 unless the goal is inside a sphere or outside the workspace
    inwards = gap > _SLACK_M and np.linalg.norm(here - there) <= gap + _SLACK_M
    position = reach(there, spheres, here) if inwards else along(way, step_m)
    return position - here, turn_towards(camera[:3, :3], goal[:3, :3])


def reach(goal: ArrayLike, spheres: Spheres, start: ArrayLike) -> Array:
    """The position [3] to command from `start` [3] in one action so that the camera ends as near as possible to `goal`.

    After an action `clip` pushes the camera out of one sphere after another. A sphere pushes every point on a ray from
    its centre to the same point of its surface, and this point may lie inside an earlier sphere. So a goal inside one
    sphere can be reached by a command that lies deep inside another one. Commands that use two such pushes are tried
    too. A position outside all spheres is preferred unless another command comes nearer by more than 1 cm. Commands
    beyond the limit of an action are not used.
    """
    goal = np.asarray(goal, dtype=np.float64)
    commands = goal[None]
    for _ in range(2):
        rays = commands[:, None, None] + _SHARES[:, None] * (spheres.centers_m[:, None] - commands[:, None, None])
        commands = np.concatenate([commands, rays.reshape(-1, 3)])
    commands = np.concatenate([_outside(goal, spheres)[None], commands])
    misses = np.linalg.norm(clip(commands, spheres) - goal, axis=1)
    misses[0] -= _WORTH_M
    misses[1:][(np.abs(commands[1:] - start) > ACTION_LIMIT).any(axis=1)] = np.inf
    return commands[np.argmin(misses.round(4))]


def turn_towards(rotation: ArrayLike, goal_rotation: ArrayLike) -> Array:
    """Angles [3] (radians, about the fixed axes, each at most 0.5) that turn `rotation` [3, 3] towards another."""
    turn = Rotation.from_matrix(np.asarray(goal_rotation) @ np.asarray(rotation).T).as_rotvec()
    angle = float(np.linalg.norm(turn))
    angles = euler_xyz(Rotation.from_rotvec(turn).as_matrix())
    share = 1.0
    # Euler angles are not linear in the share of the turn. So the share is reduced until the angles are allowed.
    while np.abs(angles).max() > ACTION_LIMIT:
        share = min(0.95 * share, ACTION_LIMIT * 1.1 / angle)
        angles = euler_xyz(Rotation.from_rotvec(share * turn).as_matrix())
    return angles


def way_around(start: ArrayLike, goal: ArrayLike, spheres: Spheres) -> Array:
    """Corner points [K, 3] of a path from start to goal outside the spheres: a straight line if that is free.

    If the start is inside a believed sphere, the belief is wrong, because the camera is there. The sphere is then
    reduced so that the start is on its surface.
    """
    start = np.asarray(start, dtype=np.float64)
    goal = _outside(goal, spheres)
    distances = np.linalg.norm(spheres.centers_m - start, axis=1)
    spheres = Spheres(spheres.centers_m, np.minimum(spheres.radii_m, distances) - _SLACK_M)
    if _free(start[None], goal[None], spheres)[0, 0]:
        return np.stack([start, goal])
    points = np.concatenate([start[None], goal[None], _corners(start, goal, spheres)])
    lengths = np.linalg.norm(points[:, None] - points[None], axis=-1)
    lengths[~_free(points, points, spheres)] = 0.0  # no edge
    _, before = dijkstra(lengths, indices=1, return_predecessors=True)
    if before[0] < 0:  # wrong beliefs leave no free path: move up first, then above all objects
        return np.stack([start, np.array([start[0], start[1], UPPER_M[2]]), goal])
    way = [0]
    while way[-1] != 1:
        way.append(before[way[-1]])
    return points[way]


def _corners(start: Array, goal: Array, spheres: Spheres) -> Array:
    """Points where a path may bend [K, 3].

    They lie around each sphere, above the start and the goal, and next to both ends, away from each sphere's centre.
    """
    around = spheres.centers_m[:, None] + _DETOUR * spheres.radii_m[:, None, None] * _CORNERS
    heights = np.linspace(LOWER_M[2], UPPER_M[2], 6)
    above = [np.array([*end[:2], height]) for end in (start, goal) for height in heights]
    outwards = [end + reach * away for end in (start, goal) for away in unit(end - spheres.centers_m)
                for reach in _ASIDE_M]
    points = np.concatenate([around.reshape(-1, 3), above, outwards])
    return _allowed(points, spheres)


def _outside(position: ArrayLike, spheres: Spheres) -> Array:
    """The position [3] after `clip`. If this is inside a sphere, the nearest position found outside all spheres."""
    clipped = clip(position, spheres)
    if spheres.depth_m(clipped) <= _SLACK_M:
        return clipped
    around = _allowed((clipped + _SHELLS_M[:, None, None] * _CORNERS).reshape(-1, 3), spheres)
    nearest = np.linalg.norm(around - np.asarray(position), axis=1)
    return around[np.argmin(nearest)] if len(around) else clipped


def _allowed(points: Array, spheres: Spheres) -> Array:
    """The points of [K, 3] that are in the workspace and outside all spheres."""
    inside_workspace = ((points >= LOWER_M) & (points <= UPPER_M)).all(axis=1)
    outside = (np.linalg.norm(points[:, None] - spheres.centers_m, axis=-1) >= spheres.radii_m).all(axis=1)
    return points[inside_workspace & outside]


def _free(starts: Array, ends: Array, spheres: Spheres) -> np.ndarray:
    """Whether the segment from each start [A, 3] to each end [B, 3] stays outside all spheres: truth values [A, B]."""
    along = ends[None] - starts[:, None]
    square = np.maximum((along ** 2).sum(-1), 1e-18)
    free = np.ones(square.shape, dtype=bool)
    for center, radius in zip(spheres.centers_m, spheres.radii_m, strict=True):
        to_center = center - starts
        dot = np.einsum("ax,abx->ab", to_center, along)
        share = np.clip(dot / square, 0.0, 1.0)
        nearest = (to_center ** 2).sum(-1)[:, None] - 2 * share * dot + share ** 2 * square
        free &= nearest >= max(radius, 0.0) ** 2
    return free


def along(way: Array, distance_m: float) -> Array:
    """The point [3] at this distance along a path [K, 3], or the end of the path if it is shorter."""
    for here, there in pairwise(way):
        length = float(np.linalg.norm(there - here))
        if length > distance_m:
            return here + (there - here) * (distance_m / length)
        distance_m -= length
    return way[-1]
