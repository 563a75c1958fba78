"""How unlike the colours of an object are in two crops, of which a map says where what is seen in one is in the other.

Two sides of a thing may have the same form, and labels of other colours. So the crops are laid over each other. A place
is as unlike as its likest neighbour, because the map is not exact, and the light may have changed from crop to crop, so
that each channel is scaled to the same mean.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

COARSE = 4  # the crops are compared at a part of their resolution
FEWEST = 40  # places that both crops must show
FULL = 0.5  # of a place's mask
SCALED = (0.3, 3.0)  # how much another light may scale a channel
DARK = 0.02
PART = 0.1  # of the object, which is the most unlike: a label fills no more of it


def unlike(there: Tensor, here: Tensor, affine: NDArray[np.float64]) -> float:
    """By how much (0 to 1) the most unlike part of an object differs, less by how much its median place does. 0 if too
    little is seen.

    `there` and `here` are crops with their masks [4, S, S]. `affine` [3, 2] maps places (right, down, 1) of the first,
    as shares of its side, to places of the second.
    """
    linear, middle = affine[:2].T, 2 * (affine[:2].T @ (0.5, 0.5) + affine[2]) - 1
    first = F.avg_pool2d(there[None], COARSE)
    theta = torch.as_tensor(np.column_stack([linear, middle]), dtype=torch.float32)[None]
    grid = F.affine_grid(theta, list(first.shape), align_corners=False)
    second = F.grid_sample(F.avg_pool2d(here[None], COARSE), grid, align_corners=False)
    both = (first[:, 3:] > FULL) & (second[:, 3:] > FULL)
    inner = 1.0 - F.max_pool2d(1.0 - both.float(), 3, 1, 1)  # [1, 1, s, s]
    if inner.sum() < FEWEST:
        return 0.0
    a, b = _smoothed(first[:, :3], inner), _smoothed(second[:, :3], inner)
    means = [(x * inner).sum((2, 3), keepdim=True) / inner.sum() for x in (a, b)]
    b = b * (means[0] / means[1].clamp(min=DARK)).clamp(*SCALED)
    side = b.shape[-1]
    around = F.unfold(F.pad(b, [1] * 4, mode="replicate"), 3).view(3, 9, side, side)
    apart = (a[0][:, None] - around).abs().amax(0).amin(0)[inner[0, 0] > 0].sort().values
    return float(apart[int(len(apart) * (1 - PART)):].mean() - apart.median())


def _smoothed(image: Tensor, mask: Tensor) -> Tensor:
    """An image [1, 3, s, s], each place averaged with its neighbours in the mask [1, 1, s, s]."""
    return F.avg_pool2d(image * mask, 3, 1, 1) / (F.avg_pool2d(mask, 3, 1, 1) + 1e-6)
