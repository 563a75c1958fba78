"""Rendered camera images with exact labels, for training networks that estimate poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.posecnn import INPUT_PX, LABEL_PX, network_input
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import (
    IMAGE_SIZE_PX,
    INTRINSICS_PX,
    REFERENCE_RANGE_M,
    pixel_rays,
    project,
    rotation_onto,
    rotation_xyz,
)
from saccade.training.table_scenes import TableScenes

WITH_DEPTH = 0.5  # share of the images with a depth; a goal image has none


@dataclass(frozen=True)
class RenderedBatch:
    """B images with the labels of K objects.

    input [B, 5, 160, 160], see `network_input`; label [B, 80, 80], 0 for the background and k + 1 for object k; center
    (u, v) in image widths [B, K, 2]; log_scale [B, K]; rotation [B, K, 3, 3], the object's in the frame of a camera
    that is turned onto it by `rotation_onto`; seen [B, K], how many cells of `label` show the object.
    """

    input: Tensor
    label: Tensor
    center: Tensor
    log_scale: Tensor
    rotation: Tensor
    seen: Tensor

    def to(self, device: torch.device) -> RenderedBatch:
        """The same batch on a device."""
        return RenderedBatch(*(value.to(device) for value in vars(self).values()))


class RenderedScenes:
    """Renders scenes of objects on a table with the simulator. Raises SaccadeError if OpenGL does not work."""

    def __init__(self, meshes: list[Mesh]):
        self.names = [mesh.name for mesh in meshes]
        intrinsics = np.array(INTRINSICS_PX) * INPUT_PX / IMAGE_SIZE_PX
        self.world = World(tuple(meshes), size_px=INPUT_PX, intrinsics_px=intrinsics)
        self.scenes = TableScenes([mesh.size_m for mesh in meshes], len(meshes))

    def compose(self, count: int, rng: np.random.Generator) -> RenderedBatch:
        """Renders `count` images with their labels. All randomness comes from `rng`."""
        k = len(self.names)
        image = np.zeros((count, INPUT_PX, INPUT_PX, 3), dtype=np.float32)
        depth = np.zeros((count, INPUT_PX, INPUT_PX), dtype=np.float32)
        label = np.zeros((count, INPUT_PX, INPUT_PX), dtype=np.uint8)
        center, log_scale = np.zeros((count, k, 2)), np.zeros((count, k))
        rotation = np.broadcast_to(np.eye(3), (count, k, 3, 3)).copy()
        for n in range(count):
            camera, placed = self.scenes.draw(rng)
            self.world.place({self.names[which]: (at, yaw) for which, at, yaw in placed}, rng.random(3) * 255)
            gain = ((1 + rng.uniform(-0.08, 0.08, 3)) / 255.0).astype(np.float32)
            noise = rng.standard_normal(image[n].shape, dtype=np.float32)
            image[n] = (self.world.render(camera) * gain + np.float32(0.01) * noise).clip(0, 1)
            depth[n] = self.world.render_depth(camera)
            for name, mask in self.world.render_masks(camera).items():
                label[n][mask] = self.names.index(name) + 1
            for which, at, yaw in placed:
                pixel, _ = project(at, camera, INTRINSICS_PX)
                seen_as = camera[:3, :3].T @ rotation_xyz((0.0, 0.0, yaw))
                center[n, which] = pixel / IMAGE_SIZE_PX
                log_scale[n, which] = np.log(REFERENCE_RANGE_M / np.linalg.norm(at - camera[:3, 3]))
                rotation[n, which] = rotation_onto(pixel_rays(pixel, INTRINSICS_PX)).T @ seen_as
        kept = torch.as_tensor(rng.random((count, 1, 1, 1)) < WITH_DEPTH)
        entered = network_input(torch.as_tensor(image).permute(0, 3, 1, 2), torch.as_tensor(depth))
        entered[:, 3:] *= kept
        small = torch.as_tensor(label[:, ::INPUT_PX // LABEL_PX, ::INPUT_PX // LABEL_PX].astype(np.int64))
        seen = F.one_hot(small, k + 1).sum((1, 2))[:, 1:]
        center_, log_scale_, rotation_ = (torch.as_tensor(x, dtype=torch.float32)
                                          for x in (center, log_scale, rotation))
        return RenderedBatch(entered, small, center_, log_scale_, rotation_, seen)
