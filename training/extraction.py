"""Phase 2: trains the extraction network with the loss L2 (paper, equation 5 and appendix B).

The network gives masks, centres, scales and presence.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.networks import CELLS, Extraction, tally
from saccade.training.frames import FrameBatch

# An object counts as present if more than SEEN of it is visible, and as absent if less than HIDDEN is. Between the two
# it has no label.
SEEN, HIDDEN = 0.2, 0.04


def loss_l2(network: Extraction, batch: FrameBatch) -> tuple[Tensor, dict[str, float]]:
    """The loss L2 and its parts: errors of the masks, of centre and scale (which define the crop), and of presence."""
    masks, vote_logits, votes = network(batch.image.contiguous(memory_format=torch.channels_last))
    cells = F.avg_pool2d(batch.mask, batch.mask.shape[-1] // CELLS)
    masking = F.binary_cross_entropy_with_logits(masks, batch.mask)
    voting = F.binary_cross_entropy_with_logits(vote_logits, cells.clamp(0, 1))
    presence, center, log_scale = tally(vote_logits, votes)
    label = (batch.visible > SEEN).float()
    clear = ((batch.visible > SEEN) | (batch.visible < HIDDEN)).float()
    identification = (F.binary_cross_entropy_with_logits(presence, label, reduction="none") * clear).mean()
    grid = (torch.arange(CELLS, device=cells.device) + 0.5) / CELLS
    target = torch.stack([batch.center[..., 0, None, None] - grid + 0 * cells,
                          batch.center[..., 1, None, None] - grid[:, None] + 0 * cells,
                          batch.log_scale[..., None, None] + 0 * cells], dim=2)
    weight = (cells > 0.3).float()[:, :, None]
    dense = ((votes - target).abs() * weight).sum() / weight.sum().clamp(min=1.0)
    each = (center - batch.center).abs().sum(-1) + (log_scale - batch.log_scale).abs()
    whole = (each * label).sum() / label.sum().clamp(min=1.0)
    loss = 10 * masking + 5 * voting + identification + 5 * dense + 5 * whole
    return loss, {"mask": float(masking.detach()), "presence": float(identification.detach()),
                  "dense": float(dense.detach()), "whole": float(whole.detach())}


@torch.inference_mode()
def extraction_errors(network: Extraction, batch: FrameBatch) -> dict[str, float]:
    """The errors of the network on a batch, see `errors`."""
    _, vote_logits, votes = network(batch.image.contiguous(memory_format=torch.channels_last))
    return errors(*tally(vote_logits, votes), batch)


def errors(presence: Tensor, center: Tensor, log_scale: Tensor, batch: FrameBatch) -> dict[str, float]:
    """Median and 90th percentile of the errors of centre (pixels of 480) and log scale, and two rates of presence.

    The rates are the shares of visible objects (`hit`) and of hidden or absent objects (`false`) that count as present.
    """
    seen, hidden = batch.visible > SEEN, batch.visible < HIDDEN
    pixels = 480 * (center - batch.center).norm(dim=-1)[seen].float().cpu().numpy()
    scales = (log_scale - batch.log_scale).abs()[seen].float().cpu().numpy()
    return {"centre_px": float(np.median(pixels)), "centre_px_90": float(np.quantile(pixels, 0.9)),
            "log_scale": float(np.median(scales)), "log_scale_90": float(np.quantile(scales, 0.9)),
            "hit": float((presence[seen] > 0).float().mean()), "false": float((presence[hidden] > 0).float().mean())}
