"""The view encoder: a crop of any object becomes a unit vector, near to that of a similar view of the same object.

It knows no object. What an object looks like is kept in a bank: the vectors of its views from all around.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

VECTOR = 128


def _block(inputs: int, outputs: int) -> nn.Sequential:
    """Halves the side."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, 2, padding=1), nn.GroupNorm(8, outputs), nn.SiLU(),
                         nn.Conv2d(outputs, outputs, 3, padding=1), nn.GroupNorm(8, outputs), nn.SiLU())


class ViewEncoder(nn.Module):
    """Crops with their masks [B, 4, 64, 64] -> unit vectors [B, 128]."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(_block(4, 32), _block(32, 64), _block(64, 96), _block(96, 128), nn.Flatten())
        self.head = nn.Sequential(nn.Linear(128 * 16, 256), nn.SiLU(), nn.Linear(256, VECTOR))
        self.log_sharpness = nn.Parameter(torch.tensor(2.5))  # how fast the likelihood falls with the similarity

    def forward(self, crop: Tensor) -> Tensor:
        rgb, mask = crop[:, :3], crop[:, 3:]
        return F.normalize(self.head(self.convolutions(torch.cat([rgb * mask, mask], dim=1) - 0.25)).float(), dim=-1)
