"""The rules of the task (paper, section 4.1): where the camera starts and may go, what an action does, and what success
is.

These are functions of poses without rendering. So simulator, evaluator, planner and training share one definition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from saccade.shared.errors import SaccadeError, told
from saccade.shared.world.geometry import Array, direction, look_at, rotation_angle, rotation_xyz, spherical, wrap
from saccade.shared.world.symmetry import NONE, turned_about, turns_of
from saccade.shared.world.workspace import Space

MAX_STEPS = 350
ACTION_LIMIT = 0.5  # metres and radians, each component
LOWER_M = np.array([-0.5, -0.5, 0.1])  # the workspace of the camera
UPPER_M = np.array([0.5, 0.5, 0.6])
CLEARANCE_M = 0.06  # a sphere's radius is half the diagonal of the object's box plus this
GOAL_CLEARANCE_M = 0.05  # the same for the nearest goals, which the clearance above then pushes out
SUCCESS_TRANSLATION_M = 0.075
SUCCESS_ROTATION_RAD = 0.5
START_ELEVATION_RAD, START_RANGE_M = np.pi / 4, 0.65
TOLERANCE_M = 1e-9


@dataclass(frozen=True)
class Spheres:
    """The spheres that `clip` pushes the camera out of: centres [N, 3] and radii [N], in metres."""

    centers_m: Array
    radii_m: Array

    def depth_m(self, position: ArrayLike) -> float:
        """How deep a position [3] is inside the sphere in which it is deepest, in metres. At most 0 if it is outside
        all spheres."""
        if len(self.radii_m) == 0:
            return 0.0
        return float((self.radii_m - np.linalg.norm(self.centers_m - np.asarray(position), axis=1)).max())


def spheres_around(centers_m: ArrayLike, sizes_m: ArrayLike) -> Spheres:
    """The spheres around objects with box centres [N, 3] and box sizes [N, 3], in metres."""
    radii = np.linalg.norm(np.asarray(sizes_m, dtype=np.float64).reshape(-1, 3), axis=1) / 2 + CLEARANCE_M
    return Spheres(np.asarray(centers_m, dtype=np.float64).reshape(-1, 3), radii)


def start_pose() -> Array:
    """Pose world_from_camera [4, 4] at the beginning of every episode: at azimuth 0, looking at the centre of the
    table."""
    return look_at(START_RANGE_M * direction(0.0, START_ELEVATION_RAD), np.zeros(3))


def clip(position: ArrayLike, spheres: Spheres) -> Array:
    """Returns the allowed position for each position [..., 3] (metres): it is pushed radially out of one sphere after
    another, and then into the workspace.

    This is done once, as in the benchmark. The benchmark's goals were clipped in the same way, and a few of them lie
    inside a sphere because a later sphere moved them there. With a stricter rule no agent could reach all of them.
    """
    result = np.asarray(position, dtype=np.float64)
    for center, radius in zip(spheres.centers_m, spheres.radii_m, strict=True):
        offset = result - center
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        away = np.where(distance > TOLERANCE_M, offset / np.maximum(distance, TOLERANCE_M), (0.0, 0.0, 1.0))
        result = np.where(distance < radius, center + radius * away, result)
    return np.clip(result, LOWER_M, UPPER_M)


def numbers(given: ArrayLike, shape: tuple[int, ...], what: str, need: str) -> Array:
    """Returns a copy of what was given as an array of this shape. Raises SaccadeError, which begins with `what` and
    ends with what is needed, if it is something else or not finite."""
    try:
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SaccadeError(f"{what} is {told(given)}: give {need}") from error
    if array.shape != shape:
        raise SaccadeError(f"{what} of shape {list(array.shape)}: give {need}")
    if not np.isfinite(array).all():
        raise SaccadeError(f"{what} is not finite: give {need}")
    return array


def apply_action(world_from_camera: ArrayLike, translation_m: ArrayLike, rotation_rad: ArrayLike) -> Array:
    """Returns the camera pose [4, 4] after an action, before `clip`. The camera is moved by `translation_m` [3] and
    turned by the angles `rotation_rad` [3], both along the axes of the world.

    Components that exceed the limit of 0.5 are reduced to it. The rotation is made orthonormal again. Raises
    SaccadeError if one of the three has another shape, or numbers that are not finite.
    """
    before = numbers(world_from_camera, (4, 4), "world_from_camera", "4x4 finite numbers")
    shift = numbers(translation_m, (3,), "translation_m", "3 finite numbers")
    turn = rotation_xyz(np.clip(numbers(rotation_rad, (3,), "rotation_rad", "3 finite numbers"),
                                -ACTION_LIMIT, ACTION_LIMIT))
    u, _, vt = np.linalg.svd(turn @ before[:3, :3])
    after = np.eye(4)
    after[:3, :3] = u @ vt
    after[:3, 3] = before[:3, 3] + np.clip(shift, -ACTION_LIMIT, ACTION_LIMIT)
    return after


def success(world_from_camera: ArrayLike, goal_world_from_camera: ArrayLike) -> bool:
    """Whether a camera pose [4, 4] is within both tolerances of the goal pose [4, 4]: 7.5 cm and 0.5 rad (paper,
    section 4.1)."""
    camera, goal = np.asarray(world_from_camera), np.asarray(goal_world_from_camera)
    near = np.linalg.norm(camera[:3, 3] - goal[:3, 3]) < SUCCESS_TRANSLATION_M
    return bool(near and rotation_angle(camera[:3, :3], goal[:3, :3]) < SUCCESS_ROTATION_RAD)


def equal_goals(goal_world_from_camera: ArrayLike, center_m: ArrayLike, symmetry: int, spheres: Spheres) -> Array:
    """All poses [N, 4, 4] from which a target at `center_m` [3] looks as from the goal pose [4, 4], which is the first.

    Those that the camera cannot come near to, because another object or the end of the workspace is in the way, are
    left out.
    """
    goals = turned_about(center_m, goal_world_from_camera, turns_of(symmetry)[1:])
    gaps = np.linalg.norm(clip(goals[:, :3, 3], spheres) - goals[:, :3, 3], axis=1)
    first = np.array(goal_world_from_camera, dtype=np.float64)[None]
    return np.concatenate([first, goals[gaps < SUCCESS_TRANSLATION_M]])


def nearest_goal(world_from_camera: ArrayLike, goals: Array) -> Array:
    """The goal pose [4, 4] of [N, 4, 4] to which a camera pose [4, 4] is nearest, in units of both tolerances: if the
    camera is within those of any goal, it is within those of this one."""
    if len(goals) == 1:
        return goals[0]
    camera = np.asarray(world_from_camera)
    apart = np.linalg.norm(goals[:, :3, 3] - camera[:3, 3], axis=1) / SUCCESS_TRANSLATION_M
    return goals[np.argmin(np.maximum(apart, rotation_angle(goals[:, :3, :3], camera[:3, :3]) / SUCCESS_ROTATION_RAD))]


@dataclass(frozen=True)
class GoalViews:
    """The views that look like the goal image: camera poses [G, 4, 4], the centres [G, 3] (metres) of the targets that
    they show, and the numbers of these among those of their kind."""

    world_from_camera: Array
    centers_m: Array
    instances: tuple[int, ...]

    def nearest(self, world_from_camera: ArrayLike) -> int:
        """The number of the view to which a camera pose [4, 4] is nearest, as in `nearest_goal`."""
        if len(self.instances) == 1:
            return 0
        near = nearest_goal(world_from_camera, self.world_from_camera)
        return int(np.flatnonzero((self.world_from_camera == near).all((1, 2)))[0])


def views_of_all(goal_world_from_camera: ArrayLike, world_from_target: ArrayLike, world_from_same: ArrayLike,
                 instances: Sequence[int], symmetry: int, space: Space | None, spheres: Spheres) -> GoalViews:
    """The views from which any target looks as from the goal pose [4, 4], where it had the pose [4, 4] when the goal
    image was taken. The targets have the poses [I, 4, 4] now.

    A view is moved with its target as if both were one piece. Those that the camera cannot come near to are left out,
    unless none is left.
    """
    poses = np.asarray(world_from_same, dtype=np.float64)
    seen_from = np.linalg.inv(np.asarray(world_from_target, dtype=np.float64)) @ np.asarray(goal_world_from_camera)
    around = turned_about(np.zeros(3), seen_from, turns_of(symmetry))  # in the target's own frame
    views = (poses[:, None] @ around).reshape(-1, 4, 4)
    which = np.repeat(np.arange(len(poses)), len(around))
    eyes = views[:, :3, 3]
    if space is None:
        gaps = np.linalg.norm(clip(eyes, spheres) - eyes, axis=1)
    else:
        gaps = np.maximum(np.linalg.norm(space.reach.nearest(eyes) - eyes, axis=1), -space.room_m(eyes))
    near = gaps < SUCCESS_TRANSLATION_M
    if not near.any():
        near = np.arange(len(views)) == 0
    return GoalViews(views[near], poses[which[near], :3, 3], tuple(instances[k] for k in which[near]))


def errors(position: ArrayLike, goal_position: ArrayLike, target_center: ArrayLike) -> tuple[float, float, float]:
    """Returns (|azimuth| rad, |elevation| rad, |range| m) between two camera positions [3], as seen from the centre of
    the target [3]."""
    azimuth, elevation, distance = spherical(position, target_center)
    goal_azimuth, goal_elevation, goal_distance = spherical(goal_position, target_center)
    return (float(abs(wrap(azimuth - goal_azimuth))), float(abs(elevation - goal_elevation)),
            float(abs(distance - goal_distance)))


class Episode:
    """The way of the camera through one scene, by the rules of the task.

    The episode ends when the camera is at the goal, as in the paper. With `until="declared"` it ends when the agent
    first says that it is there. Both also end after `max_steps`. With `judged=False` there is no goal to judge by, and
    no episode succeeds. If the target at `center_m` [3] is symmetric, any view that looks like the goal's is the goal.
    With a `space` the camera runs through nothing (shared/world/workspace.py), otherwise the rule of the paper holds.
    It begins at `start` [4, 4]. Where the world changes, `change` tells it.
    """

    def __init__(self, goal_world_from_camera: ArrayLike, spheres: Spheres, *, max_steps: int = MAX_STEPS,
                 judged: bool = True, until: Literal["reached", "declared"] = "reached",
                 center_m: ArrayLike = (0.0, 0.0, 0.0), symmetry: int = NONE, start: ArrayLike | None = None,
                 space: Space | None = None):
        goals = equal_goals(goal_world_from_camera, center_m, symmetry, spheres)
        self.views = GoalViews(goals, np.tile(np.asarray(center_m, dtype=np.float64), (len(goals), 1)),
                               (1,) * len(goals))
        self.spheres, self.space, self.max_steps, self.judged, self.until = spheres, space, max_steps, judged, until
        self.there = True  # whether there is a target, and so a view to reach
        self.reached = False  # whether the camera has been at the goal, at any step
        self.step, self.declared, self.declared_true = 0, False, False
        self.camera = start_pose() if start is None else np.array(start, dtype=np.float64)
        self.camera[:3, 3] = self._allowed(self.camera[:3, 3], self.camera[:3, 3])

    def _allowed(self, before: Array, after: Array) -> Array:
        return clip(after, self.spheres) if self.space is None else self.space.moved(before, after)

    def change(self, spheres: Spheres, space: Space | None, views: GoalViews | None) -> None:
        """Takes what the world is like from now on. Without `views` there is no target, and so no success."""
        self.spheres, self.space, self.there = spheres, space, views is not None
        self.views = views or self.views

    def act(self, translation_m: ArrayLike, rotation_rad: ArrayLike, *, arrived: bool = False) -> None:
        """Moves the camera. With `arrived` the agent says that it is there with this move. Only the first such claim is
        judged."""
        before, self.camera = self.camera[:3, 3], apply_action(self.camera, translation_m, rotation_rad)
        self.camera[:3, 3] = self._allowed(before, self.camera[:3, 3])
        self.step += 1
        self.reached |= self.success
        if arrived and not self.declared:
            self.declared, self.declared_true = True, self.success

    @property
    def goal(self) -> Array:
        """The goal pose [4, 4]. If several views look like the goal image, it is the nearest one to the camera."""
        return self.views.world_from_camera[self.views.nearest(self.camera)]

    @property
    def target(self) -> tuple[Array, int]:
        """The centre [3] of the target that `goal` shows, and its number among those of its kind."""
        nearest = self.views.nearest(self.camera)
        return self.views.centers_m[nearest], self.views.instances[nearest]

    @property
    def success(self) -> bool:
        """Whether the camera is at the goal now. This is judged after every action, so it is never true at the
        start."""
        return self.judged and self.there and self.step > 0 and success(self.camera, self.goal)

    @property
    def done(self) -> bool:
        """Whether the episode is over: the camera is at the goal (or the agent has said so), or no steps are left."""
        return (self.reached if self.until == "reached" else self.declared) or self.step >= self.max_steps
