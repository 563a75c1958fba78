"""The data for training the paper's networks: views from 0.40 m, and images composed of them (paper, appendix B)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.cropping import warp
from saccade.services.perception.paper import CANVAS_PX, CROP_SIDE_M
from saccade.shared.render.views import TILE_PX, ObjectViews
from saccade.shared.world.windows import CROP_PX
from saccade.training.crops import REFERENCE_SHELL
from saccade.training.frames import FrameBatch

# Limits of 0.40 m / range for every object in an image. Ranges are drawn uniformly; the paper does not say how.
SCALES = (0.283, 4.0)
EMPTY = 0.3  # share of the images without the object
LEVELS = 4  # levels of the tile pyramid: 128, 64, 32 and 16 pixels
SAMPLES = 4  # samples per pixel of a clean view along each axis, so that a tile that is made smaller does not flicker

Uniform = Callable[..., Tensor]


@dataclass(frozen=True)
class CleanCrops:
    """B clean views of one object on black [B, 3, 64, 64], with the same properties as `training.crops.CropBatch`."""

    target: Tensor

    @property
    def rgb(self) -> Tensor:
        """The view."""
        return self.target

    @property
    def masked(self) -> Tensor:
        """The input of the CCN: the view."""
        return self.target

    @property
    def visible(self) -> Tensor:
        """The share of the object that is visible [B], always 1."""
        return torch.ones(len(self.target), device=self.target.device)


class CleanViews:
    """The dataset of phase 1: views of one object from 0.40 m. Each crop covers the whole camera image."""

    def __init__(self, views: ObjectViews, device: torch.device):
        self.device = device
        self.azimuth = torch.as_tensor(views.azimuth_rad, dtype=torch.float32, device=device)
        self.elevation = torch.as_tensor(views.elevation_rad, dtype=torch.float32, device=device)
        crops = [_in_image(tiles, views.crop_side_m) for tiles in _reference(views).split(50)]
        self.crops = torch.cat(crops).to(device)

    def clean(self, index: Tensor) -> Tensor:
        """Views [B, 3, 64, 64] of the directions `index` [B]."""
        return self.crops[index].float() / 255.0

    def compose(self, index: Tensor, generator: torch.Generator, *, jitter: float = 0.0) -> CleanCrops:
        """The clean views as a batch. The name is that of `CropComposer`, but nothing is random here."""
        return CleanCrops(self.clean(index))


class PaperFrames:
    """The images of phase 2: the object and one other object in front of two rectangles.

    Both objects are anywhere in the image and at any scale.
    """

    def __init__(self, views: ObjectViews, others: list[ObjectViews], device: torch.device):
        self.device = device
        self.pyramids = [_pyramid(v, device) for v in (views, *others)]
        # The side of each object's tiles at scale 1, in image widths.
        self.ratios = [v.crop_side_m / CROP_SIDE_M for v in (views, *others)]
        self.coverage = self.pyramids[0][0][:, 3].float().mean((1, 2)) / 255.0  # mean coverage of each tile [N]

    def compose(self, index: Tensor, generator: torch.Generator) -> FrameBatch:
        """Composes images of the object in the directions `index` [B] (K = 1). Where it is absent, `visible` is 0."""
        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.device)

        count = len(index)
        center, scale = _place(count, uniform)
        there = uniform(count) >= EMPTY
        mine = self._layer(0, index, center, scale) * there[:, None, None, None]
        other, other_scale = self._distractor(count, uniform)
        covered = (other_scale > scale)[:, None, None, None]  # the nearer one hides the farther
        image = _backgrounds(count, uniform)
        for layer in (torch.where(covered, mine, other), torch.where(covered, other, mine)):
            image = layer[:, :3] + image * (1 - layer[:, 3:])
        mask = mine[:, 3:] * torch.where(covered, 1 - other[:, 3:], 1.0)
        whole = self.coverage[index] * (self.ratios[0] * scale * CANVAS_PX) ** 2
        visible = mask.sum((1, 2, 3)) / whole.clamp(min=1.0, max=0.5 * CANVAS_PX ** 2)
        return FrameBatch(image, mask, (center[:, None] + 1) / 2, scale.log()[:, None], visible[:, None])

    def _distractor(self, count: int, uniform: Uniform) -> tuple[Tensor, Tensor]:
        """Layers [B, 4, 120, 120] with a random other object, and its scales [B]."""
        center, scale = _place(count, uniform)
        which = (uniform(count) * (len(self.pyramids) - 1)).long() + 1
        draw = uniform(count)
        layer = torch.zeros(count, 4, CANVAS_PX, CANVAS_PX, device=self.device)
        for k in range(1, len(self.pyramids)):
            rows = torch.nonzero(which == k).squeeze(1)
            if len(rows):
                index = (draw[rows] * len(self.pyramids[k][0])).long()
                layer[rows] = self._layer(k, index, center[rows], scale[rows])
        return layer, scale

    def _layer(self, which: int, index: Tensor, center: Tensor, scale: Tensor) -> Tensor:
        """Layers [B, 4, 120, 120] of tiles at these centres and scales, from the pyramid level of about this size."""
        scale = scale * self.ratios[which]
        levels = torch.log2(TILE_PX / (scale * CANVAS_PX)).round().clamp(0, LEVELS - 1).long()
        layer = torch.empty(len(index), 4, CANVAS_PX, CANVAS_PX, device=self.device)
        for level in range(LEVELS):
            rows = torch.nonzero(levels == level).squeeze(1)
            if len(rows):
                tiles = self.pyramids[which][level][index[rows]].float() / 255.0
                layer[rows] = warp(tiles, center[rows], scale[rows], torch.zeros_like(scale[rows]), CANVAS_PX)
        return layer


def _reference(views: ObjectViews) -> Tensor:
    """The tiles from 0.40 m [N, 4, 128, 128] uint8."""
    return torch.as_tensor(views.tiles[REFERENCE_SHELL]).permute(0, 3, 1, 2).contiguous()


def _pyramid(views: ObjectViews, device: torch.device) -> list[Tensor]:
    """The tiles from 0.40 m [N, 4, T, T] uint8 with T = 128, 64, 32 and 16 pixels."""
    levels = [_reference(views)]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1].float(), 2).round().to(torch.uint8))
    return [level.to(device) for level in levels]


def _in_image(tiles: Tensor, side_m: float) -> Tensor:
    """Tiles [N, 4, 128, 128] as the camera's image shows them from 0.40 m, reduced to [N, 3, 64, 64] uint8."""
    scale, nought = torch.full((len(tiles),), side_m / CROP_SIDE_M), torch.zeros(len(tiles))
    large = warp(tiles[:, :3].float(), torch.zeros(len(tiles), 2), scale, nought, SAMPLES * CROP_PX)
    return F.avg_pool2d(large, SAMPLES).round().to(torch.uint8)


def _place(count: int, uniform: Uniform) -> tuple[Tensor, Tensor]:
    """Draws centres [B, 2] uniformly in the image ([-1, 1]), and scales [B] whose ranges are uniform."""
    far, near = (1 / scale for scale in SCALES)
    return uniform(count, 2) * 2 - 1, 1 / (near + (far - near) * uniform(count))


def _backgrounds(count: int, uniform: Uniform) -> Tensor:
    """Draws backgrounds [B, 3, 120, 120]: two rectangles of random colour, place, size and direction on black."""
    axis = (torch.arange(CANVAS_PX, device=uniform(1).device) + 0.5) / CANVAS_PX * 2 - 1
    image = torch.zeros(count, 3, CANVAS_PX, CANVAS_PX, device=axis.device)
    for _ in range(2):
        angle, center, half = uniform(count, 1, 1) * math.pi, uniform(count, 2) * 2 - 1, uniform(count, 2) * 1.3 + 0.2
        x, y = axis[None, None] - center[:, :1, None], axis[None, :, None] - center[:, 1:, None]
        along, across = x * angle.cos() + y * angle.sin(), y * angle.cos() - x * angle.sin()
        inside = (along.abs() < half[:, :1, None]) & (across.abs() < half[:, 1:, None])
        image = torch.where(inside[:, None], uniform(count, 3, 1, 1), image)
    return image
