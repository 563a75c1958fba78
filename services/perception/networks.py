"""Networks that find the objects: the extraction network looks at the whole image, the identity network at a crop.

They have the roles of the networks in the paper's tables: a mask network, a spatial transformer network that gives
centre and scale, and an identity network that says whether the object is there.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.shared.model.generative_model import conv_stack

INPUT_PX = 120  # side of the image that the extraction network sees
MASK_PX = 60  # side of its masks
CELLS = 30  # side of its grid of votes


def block(channels_in: int, channels_out: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels_out, 3, stride, padding=dilation, dilation=dilation),
                         nn.LeakyReLU(0.1))


def normed(channels_in: int, channels_out: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A convolution whose outputs are normalised, so that training needs fewer steps."""
    return nn.Sequential(nn.Conv2d(channels_in, channels_out, 3, stride, padding=dilation, dilation=dilation),
                         nn.GroupNorm(8, channels_out), nn.LeakyReLU(0.1))


class Extraction(nn.Module):
    """The extraction network: image [B, 3, 120, 120] -> masks of K objects, and votes for their centre and scale.

    Returns mask logits [B, K, 60, 60] and, on a grid of 30x30 cells, vote logits [B, K, 30, 30] and votes
    [B, K, 3, 30, 30]. A vote is the offset (du, dv) of the object's centre from the cell's centre in image widths, and
    log(scale).
    """

    def __init__(self, count: int):
        super().__init__()
        self.count = count
        self.stem = nn.Sequential(block(3, 16, stride=2), block(16, 24))
        self.middle = nn.Sequential(block(24, 48, stride=2), block(48, 48))
        self.deep = nn.Sequential(block(48, 80, stride=2), block(80, 80), block(80, 80, dilation=2),
                                  block(80, 80, dilation=4), block(80, 48))
        self.merge = block(96, 64)
        self.votes = nn.Conv2d(64, 4 * count, 1)
        self.mask = nn.Conv2d(64 + 24, count, 3, padding=1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fine = self.stem(image)
        middle = self.middle(fine)
        deep = F.interpolate(self.deep(middle), size=(CELLS, CELLS), mode="bilinear", align_corners=False)
        features = self.merge(torch.cat([middle, deep], dim=1))
        votes = self.votes(features).unflatten(1, (self.count, 4)).float()
        wide = F.interpolate(features, size=(MASK_PX, MASK_PX), mode="bilinear", align_corners=False)
        masks = self.mask(torch.cat([fine, wide], dim=1)).float()
        return masks, votes[:, :, 0], votes[:, :, 1:]


def tally(vote_logits: Tensor, votes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Averages the votes of the cells: vote logits [..., 30, 30] and votes [..., 3, 30, 30].

    Returns the presence logit [...], the centre (u, v) in image widths [..., 2] and log(scale) [...]. A cell counts
    more if it sees the object with a higher probability. The presence logit is the mean of the three highest logits.
    """
    cells = (torch.arange(CELLS, device=votes.device, dtype=votes.dtype) + 0.5) / CELLS
    u = votes[..., 0, :, :] + cells
    v = votes[..., 1, :, :] + cells[:, None]
    flat = vote_logits.flatten(-2)
    weight = torch.softmax(F.logsigmoid(flat) * 2.0, dim=-1)
    center = torch.stack([(weight * x.flatten(-2)).sum(-1) for x in (u, v)], dim=-1)
    return flat.topk(3, dim=-1).values.mean(-1), center, (weight * votes[..., 2, :, :].flatten(-2)).sum(-1)


class Identity(nn.Module):
    """The identity network: crop and mask [B, 4, 64, 64] -> presence logit [B], correction [B, 3], its log deviation.

    The correction is the offset of the object from the crop's centre (du, dv, in crop sides) and the log of the ratio
    of its scale to the crop's. The log standard deviation of the correction has the shape [B, 3].
    """

    def __init__(self, width: int = 2):
        super().__init__()
        self.convolutions = conv_stack(4, width)
        self.head = nn.Sequential(nn.Linear(256 * width, 64), nn.LeakyReLU(), nn.Linear(64, 7))

    def forward(self, crop: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        presence, correction, log_std = self.head(self.convolutions(crop)).float().split([1, 3, 3], dim=-1)
        return presence.squeeze(-1), correction, log_std.clamp(-5.0, 1.0)
