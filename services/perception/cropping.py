"""The spatial transformer: it cuts objects out of the image as a camera that looks straight at them would see them."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from saccade.shared.world.geometry import pixel_rays
from saccade.shared.world.windows import CROP_PX, Window, upright

_FINE_PX = 2 * CROP_PX  # crops are sampled at twice their resolution and then averaged
_LEVELS = 3  # levels of the image pyramid: 480, 240 and 120 pixels


class Cropper:
    """Cuts crop windows out of one image [3, H, W] and the masks [K, h, w] of its objects.

    `up` [3] is the direction of up in the camera's frame.
    """

    def __init__(self, image: Tensor, masks: Tensor, intrinsics_px: ArrayLike, up: ArrayLike):
        self.size = np.array([image.shape[-1], image.shape[-2]])  # width and height
        self._pyramid = [image[None]]
        self.masks, self.up = masks, np.asarray(up, dtype=np.float64)
        self.intrinsics_px = np.asarray(intrinsics_px, dtype=np.float64)

    def _level(self, level: int) -> Tensor:
        """A level of the image's pyramid [1, 3, h, w], which is made when it is needed."""
        while len(self._pyramid) <= level:
            self._pyramid.append(F.avg_pool2d(self._pyramid[-1], 2))
        return self._pyramid[level]

    def cut(self, window: Window) -> tuple[Tensor, Tensor]:
        """Crops [K, 3, 64, 64] and their masks [K, 1, 64, 64]. Outside the image the crop is black and the mask 0."""
        grid, levels = self._sampled(window, _FINE_PX)
        crops = torch.empty(len(grid), 3, CROP_PX, CROP_PX)
        for level in np.unique(levels):
            rows = torch.as_tensor(np.flatnonzero(levels == level))
            source = self._level(level).expand(len(rows), -1, -1, -1)
            crops[rows] = F.avg_pool2d(F.grid_sample(source, grid[rows], align_corners=False), 2)
        masks = F.grid_sample(self.masks[:, None], grid, align_corners=False)
        return crops, F.avg_pool2d(masks, 2)

    def fine(self, window: Window, side_px: int) -> Tensor:
        """Larger crops [K, 3, S, S] of S = `side_px`. Outside the image the border goes on."""
        return self._fine(*self._sampled(window, side_px))

    def fine_masked(self, window: Window, side_px: int) -> tuple[Tensor, Tensor]:
        """The same crops, and their masks [K, S, S]."""
        grid, levels = self._sampled(window, side_px)
        return self._fine(grid, levels), F.grid_sample(self.masks[:, None], grid, align_corners=False)[:, 0]

    def _fine(self, grid: Tensor, levels: NDArray[np.int64]) -> Tensor:
        crops = [F.grid_sample(self._level(level), each[None], mode="bicubic", padding_mode="border",
                               align_corners=False) for level, each in zip(levels, grid, strict=True)]
        return torch.cat(crops).clamp(0.0, 1.0)

    def _sampled(self, window: Window, side_px: int) -> tuple[Tensor, NDArray[np.int64]]:
        """Where side_px x side_px samples of the crops lie in the image [K, side_px, side_px, 2], from -1 to 1, and the
        levels [K] of the pyramid that have about as many pixels."""
        pixels = window.pixels_of(side_px, self.intrinsics_px, self.up)
        grid = torch.as_tensor(pixels / self.size * 2 - 1, dtype=torch.float32)
        texels = np.maximum(2 * window.half_tangent * self.intrinsics_px[0] / side_px, 1e-6)
        return grid, np.clip(np.round(np.log2(texels)), 0, _LEVELS - 1).astype(int)

    def corrected(self, window: Window, correction: ArrayLike) -> Window:
        """The windows, changed by corrections [K, 3]: shift (du, dv) in crop sides and log of the scale's ratio."""
        fx, fy, cx, cy = self.intrinsics_px
        correction = np.asarray(correction, dtype=np.float64)
        rotation = upright(pixel_rays(window.pixels, self.intrinsics_px), self.up)
        tangent = 2 * correction[:, :2] * window.half_tangent[:, None]
        local = np.stack([tangent[:, 0], -tangent[:, 1], -np.ones(len(tangent))], axis=-1)
        ray = np.einsum("kij,kj->ki", rotation, local)
        ahead = np.maximum(-ray[:, 2], 1e-3)
        pixels = np.stack([cx + fx * ray[:, 0] / ahead, cy - fy * ray[:, 1] / ahead], axis=-1)
        return Window(pixels, window.scales * np.exp(correction[:, 2]), window.sides_m)


def warp(tiles: Tensor, center: Tensor, scale: Tensor, roll: Tensor, side_px: int = CROP_PX) -> Tensor:
    """Draws tiles [B, C, h, w] on crops [B, C, side_px, side_px].

    The centre [B, 2] is in half crop sides, the scale [B] in crop sides, the roll [B] in radians.
    """
    cos, sin = roll.cos() / scale, roll.sin() / scale
    rows = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], dim=1)
    theta = torch.cat([rows, -rows @ center[:, :, None]], dim=2)
    grid = F.affine_grid(theta, [len(tiles), tiles.shape[1], side_px, side_px], align_corners=False)
    return F.grid_sample(tiles, grid, align_corners=False)
