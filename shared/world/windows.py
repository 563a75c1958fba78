"""Where the crop of an object lies in an image. It is cut out as a camera that looks straight at the object would see
it.

An object off the optical axis is seen sheared. Turning the camera in place is a homography, so the crop removes the
shear.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.shared.world.geometry import REFERENCE_RANGE_M, Array, pixel_rays, unit

CROP_PX = 64  # side of a crop
AHEAD = 1e-3  # a ray whose component along the optical axis is below this does not meet the image plane
NOWHERE_PX = -1e4


@dataclass(frozen=True)
class Window:
    """K crop windows: the pixels of their centres [K, 2], the scales [K] (0.40 m / range), and the sides of the crops
    at the objects [K] in metres."""

    pixels: NDArray[np.float64]
    scales: NDArray[np.float64]
    sides_m: NDArray[np.float64]

    @property
    def half_tangent(self) -> NDArray[np.float64]:
        """Tangent [K] of half the angle that each crop covers."""
        return self.sides_m / 2 * self.scales / REFERENCE_RANGE_M

    def pixels_of(self, side: int, intrinsics_px: ArrayLike, up: ArrayLike) -> Array:
        """Returns the pixels (u, v) of the image that the cells of side x side crops show [K, side, side, 2].

        A cell that shows nothing in front of the camera gets a pixel far outside of the image. `up` [3] points up, in
        the camera's frame. `intrinsics_px` are (fx, fy, cx, cy).
        """
        fx, fy, cx, cy = np.asarray(intrinsics_px, dtype=np.float64)
        rotation = upright(pixel_rays(self.pixels, intrinsics_px), up)
        axis = (np.arange(side) + 0.5) / side * 2 - 1
        # The rays are (x h, -y h, -1), rotated. So each of their components is what the column x gives, and the row y.
        columns = rotation[:, :, 0, None] * (self.half_tangent[:, None, None] * axis)  # [K, 3, side]
        rows = rotation[:, :, 1, None] * (-self.half_tangent[:, None, None] * axis) - rotation[:, :, 2, None]
        right, upward, back = columns[:, :, None, :].transpose(1, 0, 2, 3) + rows[:, :, :, None].transpose(1, 0, 2, 3)
        share = 1.0 / np.maximum(-back, AHEAD)
        pixel = np.stack([cx + fx * right * share, cy - fy * upward * share], axis=-1)
        pixel[-back <= AHEAD] = NOWHERE_PX
        return pixel

    def crop_of(self, pixels: ArrayLike, intrinsics_px: ArrayLike, up: ArrayLike) -> Array:
        """Returns where pixels (u, v) [N, 2] lie in each crop [K, N, 2]. This is the inverse of `pixels_of`.

        A crop covers [-1, 1] to the right and down. A pixel behind the camera of a crop gets NaN.
        """
        rotation = upright(pixel_rays(self.pixels, intrinsics_px), up)
        local = pixel_rays(pixels, intrinsics_px) @ rotation
        ahead = np.where(-local[..., 2] > AHEAD, -local[..., 2], np.nan)
        return np.stack([local[..., 0], -local[..., 1]], axis=-1) / (ahead * self.half_tangent[:, None])[..., None]


def upright(rays: ArrayLike, up: ArrayLike) -> Array:
    """Rotations camera_from_virtual [K, 3, 3] of cameras that look along rays [K, 3], with their top towards `up`
    [3]."""
    back = -unit(rays)
    right = np.cross(np.asarray(up, dtype=np.float64), back)
    flat = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-6
    right = unit(np.where(flat, np.array([1.0, 0.0, 0.0]), right))
    return np.stack([right, np.cross(back, right), back], axis=-1)


@functools.cache
def _plane(side: int) -> Array:
    """Rays [side * side, 3] through the cells of a crop in which half the side has a tangent of 1."""
    axis = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(axis, axis)
    return np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
