"""Proposals: what stands in an image, without names. Each pixel votes for the outline of the thing that it belongs to.

The outline is that of the whole thing, also where another one hides a part of it. Where many votes agree there is a
thing; the pixels that voted for it are its mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from saccade.services.perception.networks import block, normed

STRIDE = 4  # pixels of the image per cell of the maps
OBLIQUE = 1.5  # exponent of the cosine: the mean of 2 along a radius of the image, and 1 across
REACH = 64.0  # pixels: unit of the votes for the centre
MOST = 24  # proposals in an image
FOREGROUND = 0.5  # cells that are likelier than this to show a thing count when proposals are found
NEAR = 0.35  # votes within this share of a thing's radius of its centre are for it
SUPPORT = 0.08  # least share of the square around a thing's circle that its voters cover
PIXELS = 12.0  # least number of voters, in cells
OVERLAP = 0.5  # of two things whose voters are the same to this share, the one with fewer is none


class Proposer(nn.Module):
    """Image [B, 3, H, W] with sides that 16 divides -> a logit of the foreground [B, H/4, W/4] and votes
    [B, 3, H/4, W/4]: the offset (du, dv) of the centre of the circle around the thing from the cell, in pixels, and the
    log of its radius in pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(block(3, 24, stride=2), normed(24, 32, stride=2), normed(32, 32))
        self.middle = nn.Sequential(normed(32, 64, stride=2), normed(64, 64))
        self.deep = nn.Sequential(normed(64, 96, stride=2), normed(96, 96), normed(96, 96, dilation=2),
                                  normed(96, 96, dilation=4), normed(96, 96, dilation=8), normed(96, 64))
        self.merge = normed(128, 64)
        self.fine = nn.Sequential(normed(96, 48), nn.Conv2d(48, 4, 1))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        fine = self.stem(image - 0.5)
        middle = self.middle(fine)
        deep = F.interpolate(self.deep(middle), size=middle.shape[-2:], mode="bilinear", align_corners=False)
        wide = F.interpolate(self.merge(torch.cat([middle, deep], 1)), size=fine.shape[-2:], mode="bilinear",
                             align_corners=False)
        out = self.fine(torch.cat([fine, wide], 1)).float()
        return out[:, 0], torch.cat([out[:, 1:3] * REACH, out[:, 3:].clamp(-2.0, 2.0) + 3.0], dim=1)


@dataclass(frozen=True)
class Proposals:
    """P things in an image: centres (u, v) [P, 2] and radii [P] of the circles around them, in pixels of the network's
    image, and masks [P, H/4, W/4] from 0 to 1."""

    center: Tensor
    radius: Tensor
    masks: Tensor

    def __len__(self) -> int:
        return len(self.radius)


def half_tangent(radius_px: NDArray[np.float64], ahead: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """The tangents of the angles whose circles have these radii in the image. `ahead` are the cosines between the rays
    to their centres and the optical axis: off the axis a circle is drawn out."""
    return radius_px / focal_px * ahead ** OBLIQUE


def radius_px(half_tangent: NDArray[np.float64], ahead: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """The inverse of `half_tangent`."""
    return half_tangent * focal_px / ahead ** OBLIQUE


def places(height: int, width: int) -> Tensor:
    """The pixels (u, v) [2, H/4, W/4] at the centres of the cells."""
    u = (torch.arange(width // STRIDE) + 0.5) * STRIDE
    v = (torch.arange(height // STRIDE) + 0.5) * STRIDE
    return torch.stack([u[None].expand(len(v), -1), v[:, None].expand(-1, len(u))])


def propose(foreground: Tensor, votes: Tensor) -> Proposals:
    """Finds the peaks of the votes [3, h, w] of one image, whose foreground logits are [h, w].

    The cells vote on a map; its highest peak takes the voters near it, and so on.
    """
    height, width = foreground.shape
    share = foreground.sigmoid()
    voters = torch.nonzero(share.flatten() > FOREGROUND)[:, 0]
    place = places(height * STRIDE, width * STRIDE).flatten(1)[:, voters]
    votes = votes.flatten(1)[:, voters]
    weight = share.flatten()[voters]
    aimed = place + votes[:2]  # [2, N]
    radius = votes[2].exp()
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    left, reach = weight.clone(), (NEAR * radius).clamp(min=2.0 * STRIDE)  # a peak is known to about a cell
    while len(voters) and len(found) < MOST and float(left.sum()) >= PIXELS:
        center = _peak(aimed, left, radius, height, width)
        for _ in range(2):  # of all voters near it, also of those that count for another peak
            near = ((aimed - center[:, None]) ** 2).sum(0) < reach ** 2
            mine = weight * near
            if float(mine.sum()) < 1.0:
                break
            center = (aimed * mine).sum(1) / mine.sum()
        taken = left * near
        left = torch.where(near, torch.zeros_like(left), left)
        if float(mine.sum()) < PIXELS or float(taken.sum()) < OVERLAP * float(mine.sum()):
            if float(taken.sum()) < 1.0:  # a peak of nobody: take its strongest voter away, so that this ends
                left[int(left.argmax())] = 0.0
            continue
        size = ((radius.log() * mine).sum() / mine.sum()).exp()
        if float(mine.sum() * STRIDE ** 2 / (4 * size ** 2)) < SUPPORT:
            continue
        mask = torch.zeros(height * width).index_put((voters,), mine)
        found.append((center, size, mask.view(height, width)))
    if not found:
        return Proposals(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, height, width))
    return Proposals(*(torch.stack(part) for part in zip(*found, strict=True)))


def _peak(aimed: Tensor, weight: Tensor, radius: Tensor, height: int, width: int) -> Tensor:
    """Where most votes are [2], in pixels. The votes of large things spread farther and count less each."""
    cell = (aimed / STRIDE).long() + 8  # centres may lie outside of the image
    inside = ((cell >= 0) & (cell < torch.tensor([width + 16, height + 16])[:, None])).all(0)
    index = cell[1] * (width + 16) + cell[0]
    counts = torch.bincount(index[inside], (weight / radius)[inside], minlength=(height + 16) * (width + 16))
    smooth = F.avg_pool2d(counts.view(1, 1, height + 16, width + 16), 3, 1, 1).flatten()
    best = int(smooth.argmax())
    return torch.tensor([(best % (width + 16) - 8 + 0.5) * STRIDE, (best // (width + 16) - 8 + 0.5) * STRIDE])


def with_whole(found: Proposals, foreground: Tensor) -> Proposals:
    """What was found, and the whole image, with all that is in the foreground, logits [h, w]."""
    size = torch.tensor([foreground.shape[1], foreground.shape[0]], dtype=torch.float32) * STRIDE
    return Proposals(torch.cat([found.center, size[None] / 2]), torch.cat([found.radius, size.max()[None] / 2]),
                     torch.cat([found.masks, foreground.sigmoid()[None]]))
