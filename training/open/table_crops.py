"""Crops cut out of rendered tables, with the same labels as composed ones: real shadows, light and neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from saccade.shared.model.bank import FILLED
from saccade.shared.render.mesh import Mesh
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, circle_around, rotation_towards, unit
from saccade.shared.world.windows import CROP_PX, upright
from saccade.training.open.composer import ROLL_RAD, SCALE, SHIFT, CropMaker, Crops, uniform_of
from saccade.training.open.tables import FRAME_PX, Tables

INTRINSICS = np.array(INTRINSICS_PX) * FRAME_PX / IMAGE_SIZE_PX
LEAST_PX, LEAST_SHARE = 40, 0.2  # an object is cut out if so many of its pixels are seen, and this share of them
POINTS = 400  # of a mesh give its outline
FINE_PX = 2 * CROP_PX

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sights:
    """N objects seen on tables: the number of the table and the slot there, the object's number, directions [N, 3] from
    the object to the camera (in its frame), the shares that are seen, and the circles around their outlines: rotations
    camera_from_circle [N, 3, 3] of a camera that looks straight at a circle as its bank's camera does, and the tangents
    [N] of half the angles that the circles cover."""

    table: NDArray[np.int64]
    slot: NDArray[np.int64]
    object: NDArray[np.int64]
    direction: Array
    visible: Array
    rotation: Array
    half_tangent: Array


def sights_of(tables: Tables, meshes: Sequence[Mesh], numbers: Mapping[str, int]) -> Sights:
    """The objects that are seen well enough; `numbers` are those of the tables' objects by name."""
    points = {mesh.name: _points(mesh) for mesh in meshes}
    rows = []
    for n, slot in zip(*np.nonzero(tables.object >= 0), strict=True):
        seen = int((tables.instance[n] == slot + 1).sum())
        whole = max(int(tables.whole_px[n, slot]), 1)
        name = tables.names[tables.object[n, slot]]
        if seen < LEAST_PX or seen < LEAST_SHARE * whole or name not in numbers:
            continue
        pose = tables.camera_from_object[n, slot].astype(np.float64)
        ray, towards = unit(pose[:3, 3]), -pose[:3, :3].T @ unit(pose[:3, 3])
        up = pose[:3, :3] @ rotation_towards(-towards)[:, 1]
        rotation, half = circle_of(points[name] @ pose[:3, :3].T + pose[:3, 3], ray, up)
        rows.append((n, slot, numbers[name], towards, min(seen / whole, 1.0), rotation, half))
    return Sights(*(np.array(column) for column in zip(*rows, strict=True)))


def circle_of(points: Array, ray: Array, up: Array) -> tuple[Array, float]:
    """The circle around the outline of points [N, 3], in the frame of a camera: the rotation of a camera that looks at
    its centre with its top towards `up`, and the tangent of half its angle. `ray` points about there."""
    radius = 0.0
    for _ in range(3):
        rotation = upright(ray[None], up)[0]
        local = points @ rotation
        center, radius = circle_around(local[:, :2] / np.maximum(-local[:, 2:], 1e-3))
        ray = unit(rotation @ np.array([*center, -1.0]))
    return upright(ray[None], up)[0], radius


def _points(mesh: Mesh) -> Array:
    """Those points of a mesh that lie farthest out in some direction."""
    chosen: set[int] = set()
    rng = np.random.default_rng(0)
    vertices = mesh.vertices_m.astype(np.float64)
    for towards in unit(rng.normal(size=(POINTS, 3))):
        chosen.add(int(np.argmax(vertices @ towards)))
    return vertices[sorted(chosen)]


class TableCrops:
    """Cuts crops out of tables: images [F, 256, 256, 3], and which of a table's things each pixel shows
    [F, 256, 256], see `Tables`. `maker` has the views that banks have."""

    def __init__(self, rgb: NDArray[np.uint8], instance: NDArray[np.uint8], sights: Sights, maker: CropMaker):
        self.rgb, self.instance = (torch.from_numpy(each).to(maker.device) for each in (rgb, instance))
        self.sights, self.maker = sights, maker
        axis = (np.arange(FINE_PX) + 0.5) / FINE_PX * 2 - 1
        x, y = np.meshgrid(axis, axis)
        self.plane = torch.tensor(np.stack([x, -y], -1), dtype=torch.float32, device=maker.device)

    def draw(self, chosen: NDArray[np.int64], rng: np.random.Generator,
             index: NDArray[np.int64] | None = None) -> Crops:
        """Crops of the sights `chosen` [B]. `known` shows the nearest of the views that banks have, or that with the
        number `index` [B]."""
        sights, device, count = self.sights, self.maker.device, len(chosen)
        uniform = uniform_of(rng, device)
        scale = ((uniform(count) * 2 - 1) * SCALE).exp()
        shift, roll = (uniform(count, 2) * 2 - 1) * 2 * SHIFT, (uniform(count) * 2 - 1) * ROLL_RAD
        pixels = self._pixels(chosen, shift, scale, roll)
        grid = pixels / FRAME_PX * 2 - 1
        table, slot = (torch.as_tensor(each[chosen], device=device) for each in (sights.table, sights.slot))
        instance = self.instance[table]
        mine = instance == (slot + 1)[:, None, None]
        layers = torch.stack([mine, (instance > 0) & ~mine], 1).float()
        rgb = self.rgb[table].permute(0, 3, 1, 2).float() / 255.0
        cut = F.grid_sample(torch.cat([rgb, layers], 1), grid, align_corners=False)
        cut = F.avg_pool2d(cut, 2)
        image, alpha, beside = cut[:, :3], cut[:, 3:4], cut[:, 4:5]
        mask = self.maker.found(alpha, beside, uniform)
        image = self.maker.camera(image, uniform, gently=True)
        which = sights.object[chosen]
        direction = torch.tensor(sights.direction[chosen], dtype=torch.float32, device=device)
        if index is None:
            index = self.maker.angles(which, direction).argmin(1).cpu().numpy()
        off = torch.cat([shift, scale.log()[:, None], roll[:, None]], dim=1)
        return Crops(torch.cat([image, mask], 1), self.maker.known(which, index), torch.as_tensor(which, device=device),
                     direction, torch.tensor(sights.visible[chosen], dtype=torch.float32, device=device), off)

    def _pixels(self, chosen: NDArray[np.int64], shift: Tensor, scale: Tensor, roll: Tensor) -> Tensor:
        """Where crops lie in the frames [B, 128, 128, 2] so that each circle has its centre at `shift`, is `scale`
        times as large as in a bank, and is turned by `roll`."""
        device = self.maker.device
        rotation = torch.tensor(self.sights.rotation[chosen], dtype=torch.float32, device=device)
        half = torch.tensor(self.sights.half_tangent[chosen], dtype=torch.float32, device=device)
        # From the crop's plane to the circle's: the inverse of how the circle is drawn on the crop.
        size = scale * FILLED
        x = self.plane[..., 0][None] - shift[:, 0, None, None]
        y = -self.plane[..., 1][None] - shift[:, 1, None, None]
        cos, sin = (part[:, None, None] for part in (roll.cos() / size, roll.sin() / size))
        right, down = cos * x + sin * y, cos * y - sin * x
        rays = torch.stack([right * half[:, None, None], -down * half[:, None, None], -torch.ones_like(right)], -1)
        rays = torch.einsum("bij,bhwj->bhwi", rotation, rays)
        ahead = (-rays[..., 2]).clamp(min=1e-3)
        fx, fy, cx, cy = INTRINSICS
        return torch.stack([cx + fx * rays[..., 0] / ahead, cy - fy * rays[..., 1] / ahead], -1)
