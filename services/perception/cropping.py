"""The spatial transformer: cuts objects out of the image as a camera that looks straight at them would see them.

An object off the optical axis is seen sheared; turning the camera in place is a homography, so the crop undoes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from shared.generative_model import CROP_PX
from shared.geometry import REFERENCE_RANGE_M, pixel_rays, unit

_FINE_PX = 2 * CROP_PX  # sampled at twice the crop's resolution, then averaged
_LEVELS = 3  # of the image pyramid: 480, 240, 120


@dataclass(frozen=True)
class Window:
    """K crop windows: pixel centres [K, 2], scales [K] (0.40 m / range), sides at the objects [K] in metres."""

    pixels: NDArray[np.float64]
    scales: NDArray[np.float64]
    sides_m: NDArray[np.float64]

    @property
    def half_tangent(self) -> NDArray[np.float64]:
        """Tangent of half the angle that each crop covers [K]."""
        return self.sides_m / 2 * self.scales / REFERENCE_RANGE_M


def upright(rays: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """Rotations camera_from_virtual [K, 3, 3] of cameras that look along rays [K, 3], their top towards `up` [3]."""
    back = -unit(rays)
    right = np.cross(np.asarray(up, dtype=np.float64), back)
    flat = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-6
    right = unit(np.where(flat, np.array([1.0, 0.0, 0.0]), right))
    return np.stack([right, np.cross(back, right), back], axis=-1)


class Cropper:
    """Cuts windows out of one image [3, H, W] and the masks [K, h, w] of its objects."""

    def __init__(self, image: Tensor, masks: Tensor, intrinsics_px: ArrayLike, up: ArrayLike):
        self.size = image.shape[-1]
        self.pyramid = [image[None]]
        for _ in range(_LEVELS - 1):
            self.pyramid.append(F.avg_pool2d(self.pyramid[-1], 2))
        self.masks, self.up = masks, np.asarray(up, dtype=np.float64)
        self.intrinsics_px = np.asarray(intrinsics_px, dtype=np.float64)
        axis = (np.arange(_FINE_PX) + 0.5) / _FINE_PX * 2 - 1
        x, y = np.meshgrid(axis, axis)
        self._plane = np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3)

    def cut(self, window: Window) -> tuple[Tensor, Tensor]:
        """Crops [K, 3, 64, 64] and their masks [K, 1, 64, 64]; what is outside the image is black and unmasked."""
        grid = torch.as_tensor(self._grid(window), dtype=torch.float32)
        fx = self.intrinsics_px[0]
        texels = np.maximum(2 * window.half_tangent * fx / _FINE_PX, 1e-6)
        levels = np.clip(np.round(np.log2(texels)), 0, _LEVELS - 1).astype(int)
        crops = torch.empty(len(grid), 3, CROP_PX, CROP_PX)
        for level in np.unique(levels):
            rows = torch.as_tensor(np.flatnonzero(levels == level))
            source = self.pyramid[level].expand(len(rows), -1, -1, -1)
            crops[rows] = F.avg_pool2d(F.grid_sample(source, grid[rows], align_corners=False), 2)
        masks = F.grid_sample(self.masks[:, None], grid, align_corners=False)
        return crops, F.avg_pool2d(masks, 2)

    def _grid(self, window: Window) -> NDArray[np.float64]:
        """Where each crop pixel lies in the image [K, 128, 128, 2], in [-1, 1]."""
        fx, fy, cx, cy = self.intrinsics_px
        rotation = upright(pixel_rays(window.pixels, self.intrinsics_px), self.up)
        rays = self._plane * np.stack([window.half_tangent] * 2 + [np.ones(len(window.scales))], -1)[:, None]
        rays = rays @ rotation.transpose(0, 2, 1)
        ahead = -rays[..., 2]
        safe = np.where(ahead > 1e-3, ahead, 1e-3)
        pixel = np.stack([cx + fx * rays[..., 0] / safe, cy - fy * rays[..., 1] / safe], axis=-1)
        pixel = np.where((ahead > 1e-3)[..., None], pixel, -1e4)
        return (pixel / self.size * 2 - 1).reshape(len(rotation), _FINE_PX, _FINE_PX, 2)

    def corrected(self, window: Window, correction: ArrayLike) -> Window:
        """Windows moved by corrections [K, 3]: (du, dv) in crop sides, log of the scale's ratio."""
        fx, fy, cx, cy = self.intrinsics_px
        correction = np.asarray(correction, dtype=np.float64)
        rotation = upright(pixel_rays(window.pixels, self.intrinsics_px), self.up)
        tangent = 2 * correction[:, :2] * window.half_tangent[:, None]
        local = np.stack([tangent[:, 0], -tangent[:, 1], -np.ones(len(tangent))], axis=-1)
        ray = np.einsum("kij,kj->ki", rotation, local)
        ahead = np.maximum(-ray[:, 2], 1e-3)
        pixels = np.stack([cx + fx * ray[:, 0] / ahead, cy - fy * ray[:, 1] / ahead], axis=-1)
        return Window(pixels, window.scales * np.exp(correction[:, 2]), window.sides_m)
