"""Crops for training the CCN and the identity network: a view as the detector would cut it out, and the clean view.

Scale, shift and roll are as wrong as the detector's. Other objects stand behind the object or in front of it. The
background, the light and the mask vary. The targets are clean, so the networks learn to ignore these disturbances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.cropping import warp
from saccade.shared.render.views import ObjectViews
from saccade.shared.world.windows import CROP_PX
from saccade.training.strangers import strangers

REFERENCE_SHELL = 2  # index of the paper's range of 0.40 m among the ranges of the views


@dataclass(frozen=True)
class CropBatch:
    """B composed crops of one object.

    rgb [B, 3, 64, 64]; mask [B, 1, 64, 64] as the detector would give it; present [B] bool; visible [B], the share of
    the object that is not hidden; correction [B, 3] (du, dv in crop sides, log of the scale's ratio); target
    [B, 3, 64, 64], the clean view.
    """

    rgb: Tensor
    mask: Tensor
    present: Tensor
    visible: Tensor
    correction: Tensor
    target: Tensor

    @property
    def masked(self) -> Tensor:
        """The input of the CCN [B, 4, 64, 64]: the masked crop and its mask (o * alpha, paper, section 3.2)."""
        return torch.cat([self.rgb * self.mask, self.mask], dim=1)

    @property
    def raw(self) -> Tensor:
        """The input of the identity network [B, 4, 64, 64]: the crop and its mask."""
        return torch.cat([self.rgb, self.mask], dim=1)


class CropComposer:
    """Composes crops of the object `views`, with the `others` and strangers as clutter.

    The strangers are drawn once, from `seed`. All other randomness comes from the generator of each call.
    """

    def __init__(self, views: ObjectViews, others: list[ObjectViews], device: torch.device, seed: int = 0):
        self.views, self.device = views, device
        everything = [views, *others, strangers([views, *others], seed)]
        self.tiles = [_half_tiles(v).to(device) for v in everything]
        self.side_m = torch.tensor([v.crop_side_m for v in everything], device=device)
        self.azimuth = torch.as_tensor(views.azimuth_rad, dtype=torch.float32, device=device)
        self.elevation = torch.as_tensor(views.elevation_rad, dtype=torch.float32, device=device)

    def clean(self, index: Tensor) -> Tensor:
        """Clean views [B, 3, 64, 64] of the directions `index` [B], at the reference range."""
        return self.tiles[0][REFERENCE_SHELL, index, :3].float() / 255.0

    def undisturbed(self, index: Tensor) -> CropBatch:
        """Crops of the directions `index` [B] as they were rendered at the reference range, with nothing changed."""
        tile = self.tiles[0][REFERENCE_SHELL, index].float() / 255.0
        whole = torch.ones(len(index), device=self.device)
        return CropBatch(tile[:, :3], tile[:, 3:], whole.bool(), whole, torch.zeros(len(index), 3, device=self.device),
                         tile[:, :3])

    def compose(self, index: Tensor, generator: torch.Generator, *, present: float = 1.0,
                jitter: float = 1.0) -> CropBatch:
        """Composes crops of the directions `index` [B].

        The object is in a crop with probability `present`. `jitter` scales the errors of scale, shift and roll.
        """
        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.device)

        count = len(index)
        strength = jitter * uniform(count) ** 0.7
        log_scale = (uniform(count) * 2 - 1) * 0.25 * strength
        shift = (uniform(count, 2) * 2 - 1) * 0.15 * strength[:, None]
        roll = (uniform(count) * 2 - 1) * 0.12 * jitter
        there = uniform(count) < present
        canvas = _background(count, uniform)
        alpha = torch.zeros(count, 1, CROP_PX, CROP_PX, device=self.device)
        tile = self._tiles_of(0, index, uniform)
        full = warp(tile, 2 * shift, log_scale.exp(), roll) * there[:, None, None, None]
        for layer in ("behind", "object", "front"):
            if layer == "object":
                canvas, alpha = full[:, :3] + canvas * (1 - full[:, 3:]), full[:, 3:]
                continue
            clutter = self._clutter(count, uniform, near=(layer == "behind") & ~there, rare=layer == "front")
            canvas, alpha = clutter[:, :3] + canvas * (1 - clutter[:, 3:]), alpha * (1 - clutter[:, 3:])
        inside = _image_border(count, uniform)
        canvas, alpha = canvas * inside, alpha * inside
        visible = alpha.sum((1, 2, 3)) / full[:, 3].sum((1, 2)).clamp(min=1.0)
        gain = 1 + (uniform(count, 3, 1, 1) * 2 - 1) * 0.08
        rgb = (_on_some(canvas, uniform(count) < 0.3, _blur) * gain).clamp(0, 1)
        correction = torch.cat([shift, log_scale[:, None]], dim=1)
        return CropBatch(rgb, _detector_mask(alpha, uniform), there, visible, correction, self.clean(index))

    def _tiles_of(self, which: int, index: Tensor, uniform) -> Tensor:
        """Tiles [B, 4, 64, 64] of object `which`, in the directions `index` [B] and from random ranges."""
        shells = self.tiles[which].shape[0]
        shell = (uniform(len(index)) * shells).long()
        return self.tiles[which][shell, index].float() / 255.0

    def _clutter(self, count: int, uniform, *, near: Tensor, rare: bool) -> Tensor:
        """Layers [B, 4, 64, 64] with another object somewhere in the crop, or with nothing.

        The object is near the centre where `near` [B] is true. A stranger is twice as frequent as each other object.
        """
        which = (uniform(count) * len(self.tiles)).long().add(1).clamp(max=len(self.tiles) - 1)
        result = torch.zeros(count, 4, CROP_PX, CROP_PX, device=self.device)
        offset = (uniform(count, 2) * 2 - 1) * torch.where(near, 0.25, 1.5)[:, None]
        scale = ((uniform(count) * 2 - 1) * 0.4).exp()
        shown = near | (uniform(count) < (0.35 if rare else 0.45))
        for k in range(1, len(self.tiles)):
            rows = torch.nonzero((which == k) & shown).squeeze(1)
            if len(rows) == 0:
                continue
            index = (uniform(len(rows)) * self.tiles[k].shape[1]).long()
            ratio = torch.where(near[rows], torch.ones_like(self.side_m[0]), self.side_m[k] / self.side_m[0])
            tile = self._tiles_of(k, index, uniform)
            result[rows] = warp(tile, offset[rows], scale[rows] * ratio, torch.zeros_like(ratio))
        return result


def _half_tiles(views: ObjectViews) -> Tensor:
    tiles = torch.as_tensor(views.tiles).permute(0, 1, 4, 2, 3)
    shells, count = tiles.shape[:2]
    halves = [F.avg_pool2d(tiles[s].float(), 2).round().to(torch.uint8) for s in range(shells)]
    return torch.stack(halves).view(shells, count, 4, CROP_PX, CROP_PX)


def _background(count: int, uniform) -> Tensor:
    """Backgrounds of two flat colours with a random straight border (paper, appendix B). The second is often black."""
    axis = torch.linspace(-1, 1, CROP_PX, device=uniform(1).device)
    angle = uniform(count) * 6.2832
    side = (axis[None, None, :] * angle.cos()[:, None, None] + axis[None, :, None] * angle.sin()[:, None, None]
            > (uniform(count) * 3 - 1)[:, None, None])
    first, second = uniform(count, 3, 1, 1), uniform(count, 3, 1, 1) * (uniform(count, 1, 1, 1) < 0.5)
    return torch.where(side[:, None], second, first)


def _image_border(count: int, uniform) -> Tensor:
    """Masks [B, 1, 64, 64] that are 1 inside the image and 0 outside: some crops reach beyond the image's border."""
    axis = torch.linspace(-0.5, 0.5, CROP_PX, device=uniform(1).device)
    cut = torch.where(uniform(count) < 0.2, 0.05 + 0.45 * uniform(count), torch.full_like(uniform(count), 2.0))
    side = (uniform(count) * 4).long()
    horizontal = (axis[None] * (1 - 2 * (side % 2))[:, None]) < cut[:, None]
    across = horizontal[:, None, None, :].expand(-1, 1, CROP_PX, -1)
    return torch.where((side < 2)[:, None, None, None], across, across.transpose(2, 3)).float()


def _on_some(image: Tensor, chosen: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Applies `change` in place to the images for which `chosen` [B] is true."""
    rows = torch.nonzero(chosen).squeeze(1)
    if len(rows):
        image[rows] = change(image[rows])
    return image


def _blur(image: Tensor) -> Tensor:
    return F.avg_pool2d(image, 3, stride=1, padding=1, count_include_pad=False)


def _coarsen(factor: int) -> Callable[[Tensor], Tensor]:
    return lambda mask: F.interpolate(F.avg_pool2d(mask, factor), scale_factor=factor, mode="bilinear",
                                      align_corners=False)


def _detector_mask(alpha: Tensor, uniform) -> Tensor:
    """The true mask as a detector would give it: coarse, too large or too small, uncertain, with holes and false spots.

    An identity network that is trained on better masks reads the scale from their outline. With the masks of the
    detector it is then wrong.
    """
    count, size = len(alpha), alpha.shape[-2:]
    pick, wrong = uniform(count), uniform(count)
    mask = _on_some(alpha.clone(), pick < 0.3, _coarsen(8))
    mask = _on_some(mask, (pick > 0.3) & (pick < 0.7), _coarsen(4))
    mask = _on_some(mask, (pick > 0.7) & (pick < 0.9), _coarsen(2))
    spots = uniform(count, 1, 5, 5)

    def flip(some: Tensor) -> Tensor:
        holes = F.interpolate(spots[:len(some)], size=size, mode="bilinear", align_corners=False) > 0.8
        return torch.where(holes, 1 - some, some)

    mask = _on_some(mask, wrong < 0.15, flip)
    sure = (1 + uniform(count, 1, 1, 1) * 3), (uniform(count, 1, 1, 1) * 2 - 1) * 2.5
    doubt = F.interpolate(uniform(count, 1, 4, 4), size=size, mode="bilinear", align_corners=False)
    doubt = (doubt - 0.5) * 6 * (uniform(count, 1, 1, 1) < 0.5)
    return torch.sigmoid((mask * 2 - 1) * 2.5 * sure[0] + sure[1] + doubt)
