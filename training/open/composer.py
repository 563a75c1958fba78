"""Crops as a proposer cuts them: an object in any light, on any surface, between others, a little off.

Beside each crop stands the view that a bank has of the object from the same direction. In both, the circle around the
object's whole outline fills the share FILLED of the picture, but for what the crop is off.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.cropping import warp
from saccade.shared.model.bank import FILLED
from saccade.shared.render.surfaces import SURFACES
from saccade.shared.world.windows import CROP_PX
from saccade.training.open.tiles import TILE_PX, Tiles

BACKGROUNDS = 160  # surfaces that are made once
SCALE, SHIFT = 0.17, 0.10  # how wrong a proposal is: log of its side, place in sides
ROLL_RAD = 0.42  # things that may lie are tried in eight rolls
BESIDE, BEFORE = 0.6, 0.35  # shares of crops with a neighbour behind or beside, and before
AS_IT_IS = 0.6  # share of the images that a camera which acts gently leaves
SMALL = 0.35  # share of crops that come from few pixels


@dataclass(frozen=True)
class Crops:
    """B crops of known objects and the view that a bank has of them.

    seen [B, 4, 64, 64] is the crop with its mask (the last channel), known [B, 4, 64, 64] the flat view from the same
    direction; object [B] are numbers, direction [B, 3] point from the object to the camera; visible [B] is the share of
    the object that nothing hides. What the crop is off by [B, 4]: where the object's circle lies (right, down, in half
    sides), the log of how much larger it is, and the roll (rad).
    """

    seen: Tensor
    known: Tensor
    object: Tensor
    direction: Tensor
    visible: Tensor
    off: Tensor


def uniform_of(rng: np.random.Generator, device: torch.device) -> Callable[..., Tensor]:
    """Draws numbers from 0 to 1 of any shape on a device, from a generator that is seeded by `rng`."""
    generator = torch.Generator(device).manual_seed(int(rng.integers(2 ** 62)))

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    return uniform


class CropMaker:
    """Makes crops of objects. All randomness comes from the generator of each call, but for the surfaces, which are
    drawn from `seed`."""

    def __init__(self, tiles: list[Tiles], device: torch.device, seed: int = 0):
        self.tiles, self.device = tiles, device
        self.seed = seed
        self.views = np.array([len(each.images) for each in tiles])
        self.variants = np.array([each.images.shape[1] for each in tiles])
        self._first = np.cumsum(self.views) - self.views  # of all views, the first of each object
        self.directions, self.circles = (torch.tensor(np.concatenate([getattr(each, what) for each in tiles]),
                                                      dtype=torch.float32, device=device)
                                         for what in ("directions", "circles"))

    def view(self, which: np.ndarray, index: np.ndarray | int) -> Tensor:
        """The numbers [B] among all views, for `directions` and `circles`, of views `index` [B] of objects [B]."""
        return torch.as_tensor(self._first[which] + index, device=self.device)

    def angles(self, which: np.ndarray, towards: Tensor) -> Tensor:
        """The angles [B, V] (rad) between the views of objects [B] and directions [B, 3]; infinite where an object has
        fewer than V views."""
        number = torch.arange(int(self.views.max()), device=self.device)
        last = torch.as_tensor(self.views[which], device=self.device)[:, None]
        views = self.directions[self.view(which, 0)[:, None] + number.minimum(last - 1)]
        angle = (views @ towards[:, :, None])[..., 0].clamp(-1, 1).arccos()
        return torch.where(number < last, angle, torch.inf)

    @functools.cached_property
    def _resident(self) -> Tensor:
        """All tiles [N, 80, 80, 4] on the device, those of a view one after the other."""
        size = int((self.views * self.variants).sum())
        resident = torch.empty(size, TILE_PX, TILE_PX, 4, dtype=torch.uint8, device=self.device)
        start = 0
        for each in self.tiles:
            images = torch.from_numpy(np.array(each.images)).flatten(0, 1)
            resident[start:start + len(images)] = images.to(self.device)
            start += len(images)
        return resident

    @functools.cached_property
    def _first_tile(self) -> np.ndarray:
        sizes = self.views * self.variants
        return np.cumsum(sizes) - sizes

    @functools.cached_property
    def surfaces(self) -> Tensor:
        """Surfaces for backgrounds [S, 3, s, s], as bytes."""
        rng, makers = np.random.default_rng(self.seed), list(SURFACES.values())
        surfaces = np.stack([makers[n % len(makers)](rng)[::2, ::2] for n in range(BACKGROUNDS)])
        return torch.from_numpy(surfaces).permute(0, 3, 1, 2).to(self.device)

    def known(self, which: np.ndarray, index: np.ndarray) -> Tensor:
        """The views [B, 4, 64, 64] that banks have: flat, with the outline's circle in the middle."""
        still = torch.zeros(len(which), device=self.device)
        return self._placed(self.tile(which, index, np.zeros(len(which), dtype=int)), which, index,
                            torch.stack([still, still], 1), still + 1, still)

    def _placed(self, tiles: Tensor, which: np.ndarray, index: np.ndarray, shift: Tensor, scale: Tensor,
                roll: Tensor) -> Tensor:
        """Tiles drawn so that the circle around the outline has the centre `shift` [B, 2] and is `scale` [B] times
        as large as in a bank, turned by `roll` [B]."""
        circle = self.circles[self.view(which, index)]
        size = scale * FILLED / circle[:, 2]
        cos, sin = size * roll.cos(), size * roll.sin()
        center = torch.stack([cos * circle[:, 0] - sin * circle[:, 1], sin * circle[:, 0] + cos * circle[:, 1]], 1)
        return warp(tiles, shift - center, size, roll)

    def tile(self, which: np.ndarray, index: np.ndarray, variant: np.ndarray) -> Tensor:
        """Tiles [B, 4, 80, 80] from 0 to 1. A GPU holds all of them; otherwise they are read where they lie."""
        if self.device.type == "cpu":
            chosen = torch.from_numpy(np.stack([self.tiles[o].images[n, v]
                                                for o, n, v in zip(which, index, variant, strict=True)]))
        else:
            number = self._first_tile[which] + index * self.variants[which] + variant
            chosen = self._resident[torch.as_tensor(number, device=self.device)]
        return chosen.permute(0, 3, 1, 2).float() / 255.0

    def draw(self, which: np.ndarray, index: np.ndarray, rng: np.random.Generator) -> Crops:
        """Crops of the objects `which` [B], seen from the directions `index` [B]."""
        count = len(which)
        uniform = uniform_of(rng, self.device)
        mine = self.tile(which, index, rng.integers(self.variants[which]))
        scale = ((uniform(count) * 2 - 1) * SCALE).exp()
        shift, roll = (uniform(count, 2) * 2 - 1) * 2 * SHIFT, (uniform(count) * 2 - 1) * ROLL_RAD
        whole = self._placed(mine, which, index, shift, scale, roll)
        image = self._background(count, uniform)
        image = self._over(image, self._neighbour(which, rng, uniform) * (uniform(count) < BESIDE)[:, None, None, None])
        image = self._shadowed(image, whole[:, 3:], uniform)
        image, alpha = self._over(image, whole), whole[:, 3:]
        before = self._neighbour(which, rng, uniform, away=0.75) * (uniform(count) < BEFORE)[:, None, None, None]
        image, alpha = self._over(image, before), alpha * (1 - before[:, 3:])
        visible = alpha.sum((1, 2, 3)) / whole[:, 3].sum((1, 2)).clamp(min=1.0)
        mask = self.found(alpha, before[:, 3:], uniform)
        image = self.camera(image, uniform)
        known = self.known(which, index)
        direction = self.directions[self.view(which, index)]
        off = torch.cat([shift, scale.log()[:, None], roll[:, None]], dim=1)
        return Crops(torch.cat([image, mask], dim=1), known, torch.as_tensor(which, device=self.device), direction,
                     visible, off)

    def nothing(self, count: int, rng: np.random.Generator) -> Tensor:
        """Crops [B, 4, 64, 64] around no thing: a mask that fits nothing in the image."""
        uniform = uniform_of(rng, self.device)
        which = rng.integers(len(self.tiles), size=count)
        image = self._background(count, uniform)
        beside = self._neighbour(which, rng, uniform, away=0.6)
        image = self._over(image, beside * (uniform(count) < BESIDE)[:, None, None, None])
        mask = self._neighbour(which, rng, uniform, away=0.0)[:, 3:]
        return torch.cat([self.camera(image, uniform), self.found(mask, beside[:, 3:], uniform)], dim=1)

    @staticmethod
    def _over(below: Tensor, layer: Tensor) -> Tensor:
        return layer[:, :3] + below * (1 - layer[:, 3:])

    def _background(self, count: int, uniform) -> Tensor:
        """Surfaces as a crop shows them, or a colour [B, 3, 64, 64]."""
        chosen = (uniform(count) * len(self.surfaces)).long()
        surface = self.surfaces[chosen].float() / 255.0
        zoom, turn = 0.15 + 0.6 * uniform(count), uniform(count) * 2 * np.pi
        place = (uniform(count, 2) * 2 - 1) * (1 - zoom)[:, None]
        cos, sin = zoom * turn.cos(), zoom * turn.sin()
        rows = torch.stack([torch.stack([cos, -sin, place[:, 0]], -1), torch.stack([sin, cos, place[:, 1]], -1)], 1)
        grid = F.affine_grid(rows, [count, 3, CROP_PX, CROP_PX], align_corners=False)
        textured = F.grid_sample(surface, grid, padding_mode="reflection", align_corners=False)
        plain = uniform(count, 3, 1, 1).expand(-1, -1, CROP_PX, CROP_PX)
        return torch.where((uniform(count) < 0.7)[:, None, None, None], textured, plain)

    def _neighbour(self, which: np.ndarray, rng: np.random.Generator, uniform, away: float = 0.35) -> Tensor:
        """Other objects [B, 4, 64, 64] at least `away` half sides from the centre."""
        others = (which + rng.integers(1, len(self.tiles), len(which))) % len(self.tiles)
        index, variant = rng.integers(self.views[others]), rng.integers(self.variants[others])
        angle, far = uniform(len(which)) * 2 * np.pi, away + 0.8 * uniform(len(which))
        center = torch.stack([angle.cos() * far, angle.sin() * far], dim=1)
        return warp(self.tile(others, index, variant), center, 0.6 + 0.7 * uniform(len(which)),
                    (uniform(len(which)) * 2 - 1) * 0.3)

    def _shadowed(self, image: Tensor, alpha: Tensor, uniform) -> Tensor:
        """A blurred copy of the object's outline, moved aside, darkens what is behind it."""
        count = len(image)
        moved = warp(alpha, (uniform(count, 2) * 2 - 1) * 0.5, 0.8 + 0.4 * uniform(count), uniform(count) * 0.5)
        soft = F.avg_pool2d(moved, 7, 1, 3)
        return image * (1 - soft * (uniform(count) * 0.6)[:, None, None, None])

    def found(self, alpha: Tensor, before: Tensor, uniform) -> Tensor:
        """A mask as a proposer finds it: soft, grown or shrunk, bitten, and leaking into what stands before it."""
        count = len(alpha)
        pick = uniform(count)[:, None, None, None]
        grown, shrunk = F.max_pool2d(alpha, 5, 1, 2), -F.max_pool2d(-alpha, 5, 1, 2)
        mask = torch.where(pick < 0.2, grown, torch.where(pick < 0.4, shrunk, alpha))
        leak = F.interpolate((uniform(count, 1, 4, 4) < 0.12).float(), size=(CROP_PX, CROP_PX), mode="bilinear")
        bite = F.interpolate((uniform(count, 1, 5, 5) < 0.08).float(), size=(CROP_PX, CROP_PX), mode="bilinear")
        mask = (mask + before * leak).clamp(0, 1) * (1 - bite)
        return F.avg_pool2d(mask, 3, 1, 1)

    def camera(self, image: Tensor, uniform, gently: bool = False) -> Tensor:
        """Exposure, colours, gamma, uneven light, glare, few pixels, blur and noise. `gently` leaves some of the images
        as they are."""
        count, before = len(image), image

        def each(low: float, high: float) -> Tensor:
            return (low + (high - low) * uniform(count))[:, None, None, None]

        image = image.clamp(1e-4, 1) ** each(0.75, 1.35) * each(0.55, 1.3)
        image = image * (0.82 + 0.36 * uniform(count, 3, 1, 1))
        image = _uneven(image, uniform)
        grey = image.mean(1, keepdim=True)
        image = grey + (image - grey) * each(0.45, 1.35)
        image = image + (uniform(count, 1, 1, 1) * 0.4 + 0.6 - image) * each(-0.1, 0.2)  # haze, or hard contrast
        coarse = F.interpolate(F.interpolate(image, size=(20, 20), mode="area"), size=image.shape[-2:], mode="bilinear")
        half = F.interpolate(F.interpolate(image, size=(36, 36), mode="area"), size=image.shape[-2:], mode="bilinear")
        pick = uniform(count)[:, None, None, None]
        image = torch.where(pick < SMALL / 3, coarse, torch.where(pick < SMALL, half, image))
        image = image + (image - F.avg_pool2d(image, 3, 1, 1)) * (each(-0.5, 1.5)).clamp(min=0.0)  # sharpened
        noise = (uniform(*image.shape) - 0.5) * 12 ** 0.5
        image = (image + noise * each(0, 0.04)).clamp(0, 1)
        return torch.where((uniform(count) < AS_IT_IS)[:, None, None, None], before, image) if gently else image


def _uneven(image: Tensor, uniform) -> Tensor:
    """Light that falls off across images [B, 3, H, W], and a soft highlight on some."""
    count, (height, width) = len(image), image.shape[-2:]
    x = torch.linspace(-1, 1, width, device=image.device)[None, None, None]
    y = torch.linspace(-1, 1, height, device=image.device)[None, None, :, None]

    def each(low: float, high: float) -> Tensor:
        return (low + (high - low) * uniform(count))[:, None, None, None]

    angle = each(0, 2 * np.pi)
    image = image * (1 + each(0, 0.45) * (x * angle.cos() + y * angle.sin()))
    spot = torch.exp(-((x - each(-0.8, 0.8)) ** 2 + (y - each(-0.8, 0.8)) ** 2) / each(0.1, 0.5) ** 2)
    return image + spot * each(-0.6, 0.5).clamp(min=0.0)
