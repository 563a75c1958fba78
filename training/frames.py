"""Camera images for training the extraction network, composed from views of single objects (paper, appendix B).

The images are geometrically consistent: the camera is in the workspace and the objects stand on the table. Each object
is drawn from the view with the nearest direction and range, and warped to the place where the camera would see it.
Nearer objects cover farther ones. No scene is rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.networks import INPUT_PX, MASK_PX
from saccade.shared.render.views import TILE_PX, ObjectViews
from saccade.shared.world.geometry import (
    IMAGE_SIZE_PX,
    INTRINSICS_PX,
    REFERENCE_RANGE_M,
    direction,
    pixel_rays,
    project,
    rotation_towards,
    spherical,
)
from saccade.training.strangers import strangers, texture
from saccade.training.table_scenes import TableScenes

LEVELS = 4  # levels of the tile pyramid: 128, 64, 32 and 16 pixels
TEXTURED = 0.04  # share of images with a texture in place of the table


@dataclass(frozen=True)
class FrameBatch:
    """B images with the labels of K known objects.

    image [B, 3, 120, 120]; mask [B, K, 60, 60] (for the paper's networks [B, K, 120, 120]); center (u, v) in image
    widths [B, K, 2]; log_scale [B, K]; visible [B, K], the share of the object that is seen (0 if it is absent).
    """

    image: Tensor
    mask: Tensor
    center: Tensor
    log_scale: Tensor
    visible: Tensor


@dataclass(frozen=True)
class _Instance:
    """One object in one image."""

    scene: int  # number of the image
    object: int
    shell: int  # number of the range from which the tile was rendered
    index: int  # number of the direction
    level: int  # of the tile pyramid
    tile_from_camera: NDArray[np.float64]  # [3, 3]: camera ray -> (tile x, tile y, 1) up to scale; tile in [-1, 1]
    range_m: float
    pixel: NDArray[np.float64]  # the centre (u, v) in image widths [2]
    side_px: float  # side of the tile in the input image


class FrameComposer:
    """Composes images of the `known` objects and of strangers, which have no label.

    The strangers are drawn once, from `seed`. All other randomness comes from the generator of each call.
    """

    def __init__(self, known: list[ObjectViews], device: torch.device, seed: int = 0):
        self.known, self.device = len(known), device
        self.views = [*known, strangers(known, seed)]
        self.scenes = TableScenes([v.size_m for v in self.views], len(known))
        self.pyramid = [_pyramid(v, device) for v in self.views]
        self.coverage = [torch.as_tensor(v.tiles[..., 3].mean((2, 3)) / 255.0) for v in known]  # [S, N]
        self.directions = [direction(v.azimuth_rad, v.elevation_rad) for v in self.views]
        axis = (np.arange(INPUT_PX) + 0.5) * IMAGE_SIZE_PX / INPUT_PX
        u, v = np.meshgrid(axis, axis)
        self.rays = pixel_rays(np.stack([u, v], -1), INTRINSICS_PX)  # [120, 120, 3]
        self.rays_t = torch.as_tensor(self.rays.reshape(-1, 3), dtype=torch.float32, device=device)

    def compose(self, count: int, rng: np.random.Generator) -> FrameBatch:
        """Composes `count` images with their labels."""
        cameras, instances = [], []
        for scene in range(count):
            camera, placed = self.scenes.draw(rng)
            cameras.append(camera)
            instances += self._instances(scene, camera, placed)
        image, visible_px, mask = self._draw(cameras, instances, rng)
        return self._labels(count, instances, image, visible_px, mask)

    def _instances(self, scene: int, camera: NDArray, placed: list) -> list[_Instance]:
        """The objects in front of the camera with their nearest views, from far to near."""
        result = []
        for which, center, yaw in placed:
            views = self.views[which]
            azimuth, elevation, distance = spherical(camera[:3, 3], center)
            seen_from = direction(azimuth - yaw, elevation)
            pixel, depth = project(center, camera, INTRINSICS_PX)
            if depth <= 0.02:
                continue
            tile_px = views.crop_side_m / distance * INTRINSICS_PX[0] * INPUT_PX / IMAGE_SIZE_PX
            zoom = 2.0 * distance / views.crop_side_m
            virtual = rotation_towards(center - camera[:3, 3])
            matrix = np.diag([zoom, -zoom, -1.0]) @ virtual.T @ camera[:3, :3]
            result.append(_Instance(
                scene, which, int(np.argmin(np.abs(np.log(np.array(views.shells_m) / distance)))),
                int(np.argmax(self.directions[which] @ seen_from)),
                int(np.clip(np.round(np.log2(TILE_PX / tile_px)), 0, LEVELS - 1)), matrix, float(distance),
                pixel / IMAGE_SIZE_PX, tile_px))
        return sorted(result, key=lambda instance: -instance.range_m)

    def _draw(self, cameras: list, instances: list[_Instance], rng: np.random.Generator):
        """Draws the instances from far to near.

        Returns images [B, 3, H, W] and, for each instance, the number of visible pixels and the mask [60, 60].
        """
        image = self._backgrounds(cameras, rng)
        layers = self._warp(instances)
        alphas = [layer[3].clone() for layer in layers]
        for n, (instance, layer) in enumerate(zip(instances, layers, strict=True)):
            image[instance.scene] = layer[:3] + image[instance.scene] * (1 - layer[3:])
            for m in range(n):
                if instances[m].scene == instance.scene:
                    alphas[m] *= 1 - layer[3]
        gain = torch.as_tensor(1 + rng.uniform(-0.08, 0.08, (len(image), 3, 1, 1)), dtype=torch.float32)
        noise = torch.as_tensor(rng.standard_normal(image.shape, dtype=np.float32)) * 0.01
        image = (image * gain.to(self.device) + noise.to(self.device)).clamp_(0, 1)
        if not alphas:
            return image, [], []
        masks = F.interpolate(torch.stack(alphas)[:, None], size=(MASK_PX, MASK_PX), mode="area")[:, 0]
        return image, [float(a.sum()) for a in alphas], masks

    def _warp(self, instances: list[_Instance]) -> list[Tensor]:
        """The layer of each instance [4, 120, 120]: RGB, premultiplied by the coverage, and the coverage."""
        layers: dict[int, Tensor] = {}
        for level in range(LEVELS):
            chosen = [n for n, instance in enumerate(instances) if instance.level == level]
            if not chosen:
                continue
            tiles = torch.stack([self.pyramid[instances[n].object][level][instances[n].shell, instances[n].index]
                                 for n in chosen]).float() / 255.0
            matrices = torch.as_tensor(np.stack([instances[n].tile_from_camera for n in chosen]), dtype=torch.float32)
            local = self.rays_t @ matrices.to(self.device).transpose(1, 2)  # [n, 14400, 3]
            ahead = local[..., 2:] > 1e-3
            grid = torch.where(ahead, local[..., :2] / local[..., 2:].clamp(min=1e-3), 9.0)
            drawn = F.grid_sample(tiles, grid.view(-1, INPUT_PX, INPUT_PX, 2), align_corners=False)
            for n, layer in zip(chosen, drawn, strict=True):
                layers[n] = layer
        return [layers[n] for n in range(len(instances))]

    def _backgrounds(self, cameras: list, rng: np.random.Generator) -> Tensor:
        """Draws backgrounds [B, 3, 120, 120]: a table in one or two colours on black, rarely a texture instead."""
        images = np.zeros((len(cameras), INPUT_PX, INPUT_PX, 3), dtype=np.float32)
        for image, camera in zip(images, cameras, strict=True):
            rays = self.rays @ camera[:3, :3].T
            down = np.where(rays[..., 2] < -1e-6, rays[..., 2], -1e-6)
            hit = camera[:3, 3] + rays * (-camera[2, 3] / down)[..., None]
            table = (np.abs(hit[..., :2]) < 0.5).all(-1) & (rays[..., 2] < 0)
            image[table] = rng.random(3)
            if rng.random() < 0.25:
                angle, where = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
                side = self.rays[..., 0] * np.cos(angle) + self.rays[..., 1] * np.sin(angle) > where
                image[side & (table | (rng.random() < 0.5))] = rng.random(3)
            if rng.random() < TEXTURED:
                image[:] = texture(rng, INPUT_PX)
        return torch.as_tensor(images, device=self.device).permute(0, 3, 1, 2).contiguous()

    def _labels(self, count: int, instances, image: Tensor, visible_px: list[float], masks) -> FrameBatch:
        k = self.known
        mask = torch.zeros(count, k, MASK_PX, MASK_PX, device=self.device)
        center, log_scale, visible = torch.zeros(count, k, 2), torch.zeros(count, k), torch.zeros(count, k)
        for n, instance in enumerate(instances):
            if instance.object >= k:
                continue
            where = (instance.scene, instance.object)
            whole = float(self.coverage[instance.object][instance.shell, instance.index]) * instance.side_px ** 2
            mask[where] = masks[n]
            center[where] = torch.as_tensor(instance.pixel, dtype=torch.float32)
            log_scale[where] = float(np.log(REFERENCE_RANGE_M / instance.range_m))
            visible[where] = visible_px[n] / max(min(whole, 0.5 * INPUT_PX ** 2), 1.0)
        return FrameBatch(image, mask, center.to(self.device), log_scale.to(self.device), visible.to(self.device))


def _pyramid(views: ObjectViews, device: torch.device) -> list[Tensor]:
    """Tiles [S, N, 4, T, T] uint8 with T = 128, 64, 32 and 16 pixels."""
    levels = [torch.as_tensor(views.tiles).permute(0, 1, 4, 2, 3).contiguous()]
    for _ in range(LEVELS - 1):
        levels.append(torch.stack([F.avg_pool2d(shell.float(), 2).round().to(torch.uint8) for shell in levels[-1]]))
    return [level.to(device) for level in levels]
