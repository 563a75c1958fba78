"""Trains the proposer on rendered tables, turned, enlarged, cut and recoloured: what is a thing, and where its circle
lies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from torch import Tensor

from saccade.services.perception.proposer import STRIDE, Proposer, places, propose, radius_px
from saccade.shared.world.geometry import project
from saccade.training.open.composer import uniform_of
from saccade.training.open.table_crops import INTRINSICS, Sights, TableCrops
from saccade.training.open.tables import FRAME_PX, MOST
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import on_device

INPUT_PX = 256  # side of the images that it is trained on
ZOOM = (0.6, 2.2)  # by how much a table is enlarged
CENTER, SIZE = 4.0, 2.0  # weights of the errors of the votes beside that of the foreground
RECOLOURED = 0.5  # share of the images whose colours and light are changed
EVALUATED = 60  # tables in an evaluation
NEAR = 0.25  # of a thing's radius: a proposal within this of its centre, and within this of the log radius, finds it
WHOLE = 0.4  # a thing counts in the evaluation if so much of it is seen


@dataclass(frozen=True)
class Targets:
    """Of B images: foreground [B, h, w] (1: thing, 0: none, NaN: too small to say), and votes [B, 3, h, w] of the cells
    that show a thing."""

    foreground: Tensor
    votes: Tensor


class ProposerTask:
    """Trains the proposer."""

    def __init__(self, config: TrainingConfig, tables: TableCrops, held_out: TableCrops, device: torch.device):
        torch.manual_seed(config.seed)
        self.config, self.tables, self.held_out, self.device = config, tables, held_out, device
        self.proposer = on_device(Proposer(), device)
        self.circles, self.held_circles = by_label(tables, device), circles_px(held_out.sights)
        self.lambdas: list[float] = []

    @property
    def module(self) -> Proposer:
        """The networks."""
        return self.proposer

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        rng = np.random.default_rng([self.config.seed, 3, step])
        chosen = rng.integers(len(self.tables.rgb), size=self.config.batch_extraction)
        image, targets = images(self.tables, self.circles, chosen, rng, self.device)
        with reduced_precision(self.device):
            foreground, votes = self.proposer(image.contiguous(memory_format=torch.channels_last))
        said = ~targets.foreground.isnan()
        shown = (targets.foreground == 1.0) & said
        what = F.binary_cross_entropy_with_logits(foreground[said], targets.foreground[said])
        radius = targets.votes[:, 2].exp()
        center = ((votes[:, :2] - targets.votes[:, :2]).norm(dim=1) / radius)[shown].clamp(max=3.0).mean()
        size = (votes[:, 2] - targets.votes[:, 2]).abs()[shown].mean()
        parts = {"foreground": float(what.detach()), "center": float(center.detach()), "size": float(size.detach())}
        return what + CENTER * 0.25 * center + SIZE * 0.5 * size, parts

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    @torch.inference_mode()
    def evaluate(self) -> dict[str, float]:
        """How many of the things on held-out tables are found, and how many proposals are of no thing, per image."""
        found, things, false = 0, 0, 0
        shift, ratio = [], []
        count = min(EVALUATED, len(self.held_out.rgb))
        for n in range(count):
            image = self.held_out.rgb[n].permute(2, 0, 1)[None].float() / 255.0
            foreground, votes = self.proposer(image)
            proposals = propose(foreground[0].cpu(), votes[0].cpu())
            here = self.held_out.sights.table == n
            circles = torch.tensor(self.held_circles[here], dtype=torch.float32)
            visible = torch.tensor(self.held_out.sights.visible[here])
            taken = torch.zeros(len(proposals), dtype=torch.bool)
            for circle, seen in zip(circles, visible, strict=True):
                off = (proposals.center - circle[:2]).norm(dim=1) / circle[2]
                larger = (proposals.radius / circle[2]).log().abs()
                good = (off < NEAR) & (larger < NEAR)
                taken |= (off < 2 * NEAR) & (larger < 2 * NEAR)
                if float(seen) > WHOLE:
                    things += 1
                    found += bool(good.any())
                    if good.any():
                        shift.append(float(off[good].min()))
                        ratio.append(float(larger[good].min()))
            false += int((~taken).sum())
        return {"found": found / max(things, 1), "false": false / count,
                "shift": float(np.median(shift or [9.0])), "log_ratio": float(np.median(ratio or [9.0]))}

    @torch.inference_mode()
    def draw(self, path: Path) -> None:
        """Saves sample pictures: images over what is taken for a thing."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        image, _ = images(self.tables, self.circles, np.arange(min(8, len(self.tables.rgb))), rng,
                          self.device)
        foreground, _ = self.proposer(image)
        shown = F.interpolate(foreground.sigmoid()[:, None], scale_factor=STRIDE).expand(-1, 3, -1, -1)
        both = torch.cat([torch.cat(list(image), 2), torch.cat(list(shown), 2)], 1)
        Image.fromarray((both.clamp(0, 1) * 255).byte().permute(1, 2, 0).cpu().numpy()).save(path)


def circles_px(sights: Sights, intrinsics_px: ArrayLike = INTRINSICS) -> NDArray[np.float64]:
    """The circles [N, 3] of sights in images with these intrinsics: centre (u, v) and radius in pixels."""
    center, ahead = project(-sights.rotation[:, :, 2], np.eye(4), intrinsics_px)
    radius = radius_px(sights.half_tangent, ahead, float(np.asarray(intrinsics_px)[0]))
    return np.concatenate([center, radius[:, None]], axis=1)


def by_label(crops: TableCrops, device: torch.device) -> Tensor:
    """The circles [F, L, 3] of tables' things by their labels in `instance`, see `circles_px`; NaN where too little of
    a thing is seen."""
    sights = crops.sights
    circles = torch.full((len(crops.rgb), MOST + 1, 3), torch.nan)
    circles[sights.table, sights.slot + 1] = torch.tensor(circles_px(crops.sights), dtype=torch.float32)
    return circles.to(device)


def images(crops: TableCrops, circles: Tensor, chosen: NDArray[np.int64], rng: np.random.Generator,
           device: torch.device) -> tuple[Tensor, Targets]:
    """Images [B, 3, 256, 256] of the tables `chosen` [B], changed at random, and their targets. `circles` are those of
    all tables, see `by_label`."""
    count = len(chosen)
    uniform = uniform_of(rng, device)
    table = torch.as_tensor(chosen, device=device)
    rgb, instance = crops.rgb[table].permute(0, 3, 1, 2).float() / 255.0, crops.instance[table][:, None].float()
    # The frame's place of each pixel: turned, mirrored, enlarged and shifted.
    zoom = ZOOM[0] * (ZOOM[1] / ZOOM[0]) ** uniform(count)
    angle = (uniform(count) * 2 - 1) * torch.where(uniform(count) < 0.3, torch.pi, 0.3)
    mirror = torch.where(uniform(count) < 0.5, 1.0, -1.0)
    reach = (1 - 1 / zoom).clamp(min=0.0)
    place = (uniform(count, 2) * 2 - 1) * reach[:, None]
    cos, sin = angle.cos() / zoom, angle.sin() / zoom
    rows = torch.stack([torch.stack([cos * mirror, -sin, place[:, 0]], -1),
                        torch.stack([sin * mirror, cos, place[:, 1]], -1)], 1)
    grid = F.affine_grid(rows, [count, 1, INPUT_PX, INPUT_PX], align_corners=False)
    image = F.grid_sample(rgb, grid, padding_mode="reflection", align_corners=False)
    labels = F.grid_sample(instance, grid, mode="nearest", padding_mode="reflection", align_corners=False)
    outside = (grid.abs() > 1).any(-1)
    image = torch.where((uniform(count) < RECOLOURED)[:, None, None, None],
                        crops.maker.camera(image, uniform, gently=True), image)
    label = labels[:, 0, STRIDE // 2::STRIDE, STRIDE // 2::STRIDE].long()
    label = torch.where(outside[:, STRIDE // 2::STRIDE, STRIDE // 2::STRIDE], -1, label)
    return image, _targets(circles[table], label, rows, zoom)


def _targets(circles: Tensor, label: Tensor, rows: Tensor, zoom: Tensor) -> Targets:
    """The targets of cells with these labels [B, h, w] (-1: outside of the frame), where the tables' things have the
    circles [B, L, 3]. `rows` [B, 2, 3] are the affine maps from the images to the frames."""
    center = circles[..., :2] / FRAME_PX * 2 - 1
    back = torch.linalg.inv(rows[:, :, :2])
    mapped = ((center - rows[:, None, :, 2]) @ back.transpose(1, 2) + 1) / 2 * INPUT_PX
    size = circles[..., 2].log() + zoom.log()[:, None] + float(np.log(INPUT_PX / FRAME_PX))
    things = torch.cat([mapped, size[..., None]], -1)
    own = things[torch.arange(len(label), device=label.device)[:, None, None], label.clamp(min=0)].permute(0, 3, 1, 2)
    unknown = (label < 0) | ((label > 0) & own[:, 2].isnan())
    foreground = torch.where(unknown, torch.nan, (label > 0).float())
    place = places(INPUT_PX, INPUT_PX).to(label.device)
    votes = torch.cat([own[:, :2] - place, own[:, 2:]], 1)
    return Targets(foreground, votes.nan_to_num(0.0))
