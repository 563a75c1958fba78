"""Views of the target that look like the goal image.

Of a symmetric target there are several: the agent goes to the nearest one that it can reach, and what it has found out
at one of them holds for all. Of a target that may lie, the belief tells how the goal's camera was turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saccade.services.planner.candidates import peak
from saccade.services.planner.goal import Preference, aim, turned_onto
from saccade.services.planner.place import Ground
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import Array, look_at, pose, spherical, unit
from saccade.shared.world.symmetry import CONTINUOUS, NONE, about_vertical, turned_about, turns_of


def nearest_eye(eye: Array, center: Array, symmetry: int, camera: Array, ground: Ground) -> Array:
    """The position [3] from which a target at `center` [3] looks as it does from `eye` [3] that is the nearest to the
    camera's pose [4, 4]. Positions that the camera cannot come near to are taken only if there are no others."""
    if symmetry == NONE:
        return eye
    eyes = center + about_vertical(turns_of(symmetry)) @ (eye - center)
    nearest_first = np.lexsort([np.linalg.norm(eyes - camera[:3, 3], axis=1), ground.is_blocked(eyes)])
    return np.asarray(eyes[nearest_first[0]])


def goal_eye(target: Belief, preference: Preference, symmetry: int, camera: Array, ground: Ground) -> Array | None:
    """The position [3] from which the target most likely looks as in the goal image. None if nothing is known of it."""
    if target.goal_log_posterior is None:
        return None
    if target.goal_rotations is None or not len(target.goal_rotations):
        eye = peak(target.mean_m, target.goal_log_posterior, preference.range_m)
        return nearest_eye(eye, target.mean_m, symmetry, camera, ground)
    eyes = target.mean_m - preference.range_m * (target.goal_rotations @ preference.ray)
    return np.asarray(eyes[np.argmax(np.asarray(target.goal_rotations_log_probability))])


def goal_viewpoint(target: Belief, preference: Preference, eye: Array, *, goal_pixel: bool) -> Array:
    """The camera pose [4, 4] at `eye` [3] that shows the target at the pixel where the goal image shows it.

    Without `goal_pixel` it looks straight at the target. As in the environment, a position that the camera may not
    enter is clipped only when the camera moves there, and the attitude is kept.
    """
    if target.goal_rotations is not None and len(target.goal_rotations):
        towards = unit(target.mean_m - eye)
        nearest = target.goal_rotations[np.argmax(target.goal_rotations @ preference.ray @ towards)]
        return pose(turned_onto(nearest, preference.ray, towards), eye)
    if not goal_pixel:
        return look_at(eye, target.mean_m)
    return aim(eye, target.mean_m, preference.pixel, preference.intrinsics_px)


def heading(camera: Array, viewpoint: Array, gaze: Array, *, rolled: bool) -> Array:
    """The camera pose [4, 4] to move towards on the way from a camera [4, 4] to a viewpoint [4, 4], which is still far:
    it looks at a point [3], without roll, or rolled as at the viewpoint."""
    if rolled:
        towards = unit(gaze - camera[:3, 3])
        return pose(turned_onto(viewpoint[:3, :3], (0.0, 0.0, -1.0), towards), viewpoint[:3, 3])
    result = look_at(camera[:3, 3], gaze)
    result[:3, 3] = viewpoint[:3, 3]
    return result


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
