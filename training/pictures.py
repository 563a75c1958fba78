"""Sample pictures of a training run: inputs of the networks and their outputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from saccade.services.perception.networks import Extraction, tally
from saccade.services.perception.paper import PaperExtraction
from saccade.shared.model.generative_model import CCN
from saccade.training.ccn import Pair
from saccade.training.frames import FrameBatch
from saccade.training.rendered import RenderedBatch

_LABEL_COLOURS = torch.rand(256, 3, generator=torch.Generator().manual_seed(1)) * 0.8 + 0.2
_LABEL_COLOURS[0] = 0.0


def draw_rows(path: Path, rows: list[Tensor]) -> None:
    """Saves rows of images [N, 3, H, W] in [0, 1], one below the other, twice as large."""
    strips = [torch.cat(list(row.float().cpu().clamp(0, 1)), dim=2) for row in rows]
    picture = (torch.cat(strips, dim=1).permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    Image.fromarray(picture).resize((picture.shape[1] * 2, picture.shape[0] * 2), Image.Resampling.NEAREST).save(path)


@torch.inference_mode()
def draw_ccn(path: Path, ccn: CCN, pair: Pair) -> None:
    """Draws rows: input | masked crop | reconstruction | prediction after the transition | true view after it."""
    mean, _ = ccn.encoder(pair.first.masked)
    moved, _ = ccn.transition(mean, pair.displacement)
    drawn = [ccn.decoder(mean), ccn.decoder(moved)]
    draw_rows(path, [pair.first.rgb, pair.first.masked[:, :3], *drawn, pair.second.target])


@torch.inference_mode()
def draw_paper_extraction(path: Path, network: PaperExtraction, batch: FrameBatch, clean: Tensor) -> None:
    """Draws rows: input | true mask | predicted mask | masked crop | true crop (`clean` [B, 3, 64, 64])."""
    mask, _, _, crop, _ = network(batch.image)
    rows = (batch.image, batch.mask.expand(-1, 3, -1, -1), mask.expand(-1, 3, -1, -1), crop[:, :3], clean)
    draw_rows(path, [F.interpolate(row, size=batch.image.shape[-2:]) for row in rows])


@torch.inference_mode()
def draw_extraction(path: Path, network: Extraction, batch: FrameBatch) -> None:
    """Draws rows: input | true masks | predicted masks.

    In the input a cross marks the predicted centre of each object that is predicted to be present.
    """
    masks, vote_logits, votes = network(batch.image)
    presence, center, _ = tally(vote_logits, votes)
    size = batch.image.shape[-2:]
    true = F.interpolate(batch.mask.amax(1, keepdim=True), size=size).expand(-1, 3, -1, -1)
    seen = F.interpolate(masks.sigmoid().amax(1, keepdim=True), size=size).expand(-1, 3, -1, -1)
    marked = batch.image.clone()
    for b, k in torch.nonzero(presence > 0).tolist():
        u, v = (center[b, k] * size[0]).round().long().clamp(2, size[0] - 3).tolist()
        marked[b, :, v, u - 2:u + 3] = 1.0
        marked[b, :, v - 2:v + 3, u] = 1.0
    draw_rows(path, [marked, true, seen])


def draw_poses(path: Path, batch: RenderedBatch, labels: Tensor) -> None:
    """Draws rows: input | true labels | predicted labels. `labels` are their logits [B, K + 1, 80, 80]."""
    size = batch.input.shape[-2:]
    shown = [_LABEL_COLOURS[label.cpu()].permute(0, 3, 1, 2) for label in (batch.label, labels.argmax(1))]
    draw_rows(path, [batch.input[:, :3], *(F.interpolate(row, size=size) for row in shown)])


def draw_pairs(path: Path, seen: Tensor, known: Tensor) -> None:
    """Saves crops [B, 4, 64, 64] over their masks over known views [B, 4, 64, 64]."""
    rows = torch.cat([seen[:, :3], seen[:, 3:].expand(-1, 3, -1, -1), known[:, :3]], dim=2)
    image = torch.cat(list(rows), dim=2).clamp(0, 1).permute(1, 2, 0)
    Image.fromarray((image * 255).byte().cpu().numpy()).save(path)
