"""What the goal image asks for: which object, at which range, and at which pixel (paper, section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.shared.bus.messages import Percept
from saccade.shared.world.geometry import REFERENCE_RANGE_M, Array, look_at, pixel_rays, pose, unit

OPPOSITE = -0.99  # cosine of an angle from which on the smallest turn is not well defined


@dataclass(frozen=True)
class Preference:
    """The prior preference over observations: the target, its range and standard deviation (m), and its pixel [2].

    `intrinsics_px` (fx, fy, cx, cy) are those of the goal image.
    """

    target: str
    range_m: float
    range_std_m: float
    pixel: NDArray[np.float64]
    intrinsics_px: NDArray[np.float64]
    confidence: float  # probability that the target is in the goal image

    @property
    def ray(self) -> Array:
        """The direction [3] of the target in the frame of the goal's camera."""
        return pixel_rays(self.pixel, self.intrinsics_px)


def infer_preference(percepts: dict[str, Percept], range_std_m: float) -> Preference:
    """The preference from the goal image's percepts. The target is the object with the highest presence.

    `range_std_m` is the standard deviation of the preferred range; the uncertainty of the percept's scale is added.
    """
    name = max(sorted(percepts), key=lambda n: percepts[n].presence)
    percept = percepts[name]
    range_m = REFERENCE_RANGE_M / percept.scale
    deviation = float(np.hypot(range_std_m, percept.log_scale_std * range_m))
    return Preference(name, range_m, deviation, percept.pixel, percept.intrinsics_px, percept.presence)


def aim(position: ArrayLike, target: ArrayLike, pixel: ArrayLike, intrinsics_px: ArrayLike) -> Array:
    """The pose world_from_camera [4, 4] at `position` [3] that sees `target` [3] at `pixel` (u, v), without roll.

    If no camera without roll can see it there, as nearly above the target, the one that looks straight at the target is
    turned as little as possible.
    """
    position, target = np.asarray(position, dtype=np.float64), np.asarray(target, dtype=np.float64)
    ray = pixel_rays(pixel, intrinsics_px)  # camera frame
    towards = unit(target - position)
    reach = np.hypot(ray[1], ray[2])
    pitch = np.arcsin(np.clip(towards[2] / reach, -1.0, 1.0)) - np.arctan2(ray[1], -ray[2])
    if abs(towards[2]) > reach or abs(pitch) > np.pi / 2:
        return pose(turned_onto(look_at(position, target)[:3, :3], ray, towards), position)
    # If the heading is +x: right is -y, up is (-sin pitch, 0, cos pitch), back is -(cos pitch, 0, sin pitch).
    rotation = np.array([[0.0, -np.sin(pitch), -np.cos(pitch)], [-1.0, 0.0, 0.0],
                         [0.0, np.cos(pitch), -np.sin(pitch)]])
    seen = rotation @ ray
    heading = np.arctan2(towards[1], towards[0]) - np.arctan2(seen[1], seen[0])
    turn = np.array([[np.cos(heading), -np.sin(heading), 0.0], [np.sin(heading), np.cos(heading), 0.0], [0, 0, 1.0]])
    return pose(turn @ rotation, position)


def turned_onto(rotation: ArrayLike, ray: ArrayLike, towards: ArrayLike) -> Array:
    """A rotation world_from_camera [3, 3], turned as little as possible so that its `ray` [3] (camera's frame) points
    `towards` [3] (world)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    here, there = rotation @ np.asarray(ray), np.asarray(towards)
    axis, cosine = np.cross(here, there), float(here @ there)
    if cosine < OPPOSITE:  # about the image's own vertical, as one who looks behind
        return turned_onto(rotation @ np.diag([-1.0, 1.0, -1.0]), ray, towards)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return (np.eye(3) + cross + cross @ cross / (1.0 + cosine)) @ rotation
