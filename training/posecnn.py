"""Trains PoseCNN on rendered images: labels, votes, and rotations with the losses of Xiang et al. (2018)."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from saccade.services.perception.posecnn import (
    CELLS,
    LABEL_PX,
    PoseNetwork,
    counted,
    region_side,
    rotation_of,
)
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.views import crop_side_m
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.training.pictures import draw_poses
from saccade.training.precision import reduced_precision
from saccade.training.rendered import RenderedBatch, RenderedScenes
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import on_device

POINTS = 100  # points of each mesh in the loss of the rotation
SEEN_CELLS = 8  # an object that is seen in fewer cells of the map of labels teaches no rotation
VOTING, ROTATION = 2.0, 12.0  # weights of the losses beside that of the labels
JITTER = 0.08  # of the regions in training, in shares of their side: as wrong as the votes' centres
FOCAL_WIDTHS = INTRINSICS_PX[0] / IMAGE_SIZE_PX  # the focal length in image widths
EVALUATED = 100  # number of images in an evaluation
AHEAD = 6  # processes that render for a GPU


class PoseCnnTask:
    """Trains one network for all objects. All of a step's images are rendered for it.

    `before` are the tensors of a network from which it goes on.
    """

    def __init__(self, config: TrainingConfig, device: torch.device, before: dict[str, Tensor] | None = None):
        torch.manual_seed(config.seed)
        meshes = [load_mesh(config.objects, name) for name in config.names]
        self.batches = Batches(config)
        self.ahead: Iterator[RenderedBatch] | None = None
        network = PoseNetwork(len(meshes))
        if before is not None:
            network.load_state_dict(before)
        self.module = on_device(network, device)
        self.config, self.device = config, device
        self.lambdas: list[float] = []
        rng = np.random.default_rng(config.seed)
        points = [mesh.vertices_m[rng.integers(len(mesh.vertices_m), size=POINTS)] for mesh in meshes]
        # In units of each object's size, so that large and small objects count alike.
        points = [p / np.linalg.norm(mesh.size_m) for p, mesh in zip(points, meshes, strict=True)]
        self.points = torch.tensor(np.stack(points), dtype=torch.float32, device=device)
        self.sides_m = torch.tensor([crop_side_m(mesh.size_m) for mesh in meshes], dtype=torch.float32, device=device)
        self.symmetric = torch.tensor([name in config.symmetric for name in config.names], device=device)

    def _batch(self, count: int, step: int) -> RenderedBatch:
        return self.batches.rendered(step, count).to(self.device)

    def _next(self, step: int) -> RenderedBatch:
        """The batch of a step. A GPU would wait for it, so other processes render ahead."""
        if self.device.type == "cpu":
            return self._batch(self.config.batch_extraction, step)
        if self.ahead is None:
            self.ahead = rendered_ahead(self.config, step, max(1, min(AHEAD, (os.cpu_count() or 2) - 1)))
        return next(self.ahead).to(self.device)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        batch = self._next(step)
        generator = torch.Generator(self.device).manual_seed(step)
        with reduced_precision(self.device):
            labels, votes, features = self.module(batch.input.contiguous(memory_format=torch.channels_last))
            found = torch.nonzero(batch.seen >= SEEN_CELLS)
            quaternion = self._quaternions(features, batch, found, generator)
        labelling = F.cross_entropy(labels, batch.label)
        voting = vote_loss(votes, batch)
        turned = batch.rotation[found[:, 0], found[:, 1]]
        turning = rotation_loss(quaternion, turned, self.points[found[:, 1]], self.symmetric[found[:, 1]])
        parts = {"label": labelling, "vote": voting, "rotation": turning}
        loss = labelling + VOTING * voting + ROTATION * turning
        return loss, {name: float(value.detach()) for name, value in parts.items()}

    def _quaternions(self, features: Tensor, batch: RenderedBatch, found: Tensor,
                     generator: torch.Generator | None) -> Tensor:
        """The quaternions [R, 4] of the objects `found` [R, 2] (image, object), from regions around true centres.

        With a generator the regions are as wrong as the votes' will be.
        """
        image, which = found.T
        center, log_scale = batch.center[image, which], batch.log_scale[image, which]
        side = region_side(self.sides_m[which], log_scale.exp(), FOCAL_WIDTHS)
        if generator is not None:
            noise = torch.randn(len(found), 3, generator=generator, device=self.device) * JITTER
            center, side = center + noise[:, :2] * side[:, None], side * noise[:, 2].exp()
        return self.module.quaternions(features[image], center, side, which)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    @torch.inference_mode()
    def evaluate(self) -> dict[str, float]:
        """Median errors on 100 images that are always the same: of centre (pixels of 480), range (log) and rotation
        (rad), also for each object, and the share of the cells that have the right label."""
        batch = self._batch(EVALUATED, 2 ** 31)
        labels, votes, features = self.module(batch.input)
        found = torch.nonzero(batch.seen >= SEEN_CELLS)
        rotation = rotation_of(self._quaternions(features, batch, found, None))
        image, which = found.T
        trace = (rotation * batch.rotation[image, which]).sum((1, 2))
        angle = ((trace - 1) / 2).clamp(-1, 1).arccos()
        center_px, log_range = voted_errors(votes, batch, found)
        measured = {"label_right": float((labels.argmax(1) == batch.label).float().mean())}
        errors = {"centre_px": center_px, "log_scale": log_range, "rotation_rad": angle}
        for name, values in errors.items():
            measured[name] = float(values.median())
            for k, of in enumerate(self.config.names):
                mine = values[(which == k).to(values.device)]
                measured[f"{of}.{name}"] = float(mine.median()) if len(mine) else 0.0
        return measured

    @torch.inference_mode()
    def draw(self, path: Path) -> None:
        """Saves sample pictures."""
        batch = self._batch(6, 2 ** 31)
        draw_poses(path, batch, self.module(batch.input)[0])


class Batches(Dataset[RenderedBatch]):
    """The batches of a training run from a step on, rendered where they are asked for."""

    def __init__(self, config: TrainingConfig, start: int = 0):
        self.config, self.start = config, start

    @functools.cached_property
    def scenes(self) -> RenderedScenes:
        """What renders, in the process that asks for it."""
        return RenderedScenes([load_mesh(self.config.objects, name) for name in self.config.names])

    def __len__(self) -> int:
        return self.config.steps_extraction - self.start

    def __getitem__(self, number: int) -> RenderedBatch:
        return self.rendered(self.start + number, self.config.batch_extraction)

    def rendered(self, step: int, count: int) -> RenderedBatch:
        """The batch of a step with `count` images, always the same."""
        return self.scenes.compose(count, np.random.default_rng([self.config.seed, step]))


def rendered_ahead(config: TrainingConfig, start: int, workers: int) -> Iterator[RenderedBatch]:
    """The batches of the steps from `start` on, in their order, which `workers` processes render."""
    return iter(DataLoader(Batches(config, start), batch_size=None, num_workers=workers,
                           multiprocessing_context="spawn"))


def vote_loss(votes: Tensor, batch: RenderedBatch) -> Tensor:
    """Mean absolute error of the votes [B, K, 3, 40, 40] in the cells that show the object which they are for."""
    k = votes.shape[1]
    shown = F.one_hot(batch.label, k + 1).permute(0, 3, 1, 2)[:, 1:].float()
    weight = (F.avg_pool2d(shown, LABEL_PX // CELLS) > 0.5).float()[:, :, None]
    axis = (torch.arange(CELLS, device=votes.device) + 0.5) / CELLS
    offset = torch.stack(torch.broadcast_tensors(batch.center[..., 0, None, None] - axis,
                                                 batch.center[..., 1, None, None] - axis[:, None]), dim=2)
    target = torch.cat([F.normalize(offset, dim=2),
                        batch.log_scale[:, :, None, None, None].expand(-1, -1, 1, CELLS, CELLS)], dim=2)
    return ((votes - target).abs() * weight).sum() / weight.sum().clamp(min=1.0)


def rotation_loss(quaternion: Tensor, rotation: Tensor, points: Tensor, symmetric: Tensor) -> Tensor:
    """PLoss, and SLoss for symmetric objects (Xiang et al., 2018, section III-D): how far the points [R, P, 3] of R
    objects are from where they should be, or from the nearest one there.

    Mean squared distance; `quaternion` [R, 4] and `rotation` [R, 3, 3] are the estimate and the truth.
    """
    if len(quaternion) == 0:
        return quaternion.sum()
    estimated, true = points @ rotation_of(quaternion).transpose(1, 2), points @ rotation.transpose(1, 2)
    straight = ((estimated - true) ** 2).sum(-1).mean(-1)
    if not symmetric.any():
        return straight.mean()
    nearest = (torch.cdist(estimated, true) ** 2).min(dim=2).values.mean(-1)
    return torch.where(symmetric, nearest, straight).mean()


def voted_errors(votes: Tensor, batch: RenderedBatch, found: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of centre (pixels of 480) and of log range [R] by the votes of the true cells of the objects `found`."""
    pixels, ranges = [], []
    for image, which in found.tolist():
        shown = (batch.label[image] == which + 1).float()
        weight = F.avg_pool2d(shown[None], LABEL_PX // CELLS)[0].flatten()
        center, log_scale = counted(votes[image, which].float().cpu(), weight.cpu())
        pixels.append((center - batch.center[image, which].cpu()).norm() * IMAGE_SIZE_PX)
        ranges.append((log_scale - batch.log_scale[image, which].cpu()).abs())
    return torch.stack(pixels), torch.stack(ranges)
