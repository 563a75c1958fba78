"""The comparer: a crop and a known view of an object side by side. Are they the same thing, and what lies between them?

The view encoder proposes which views may be meant; the comparer looks at both pictures at once. So it sees what a
vector cannot hold: the small differences between near twins, and by how much the crop is off.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from saccade.services.perception.networks import block, normed

OUTPUTS = 11


class Comparison(nn.Module):
    """Crops with their masks [B, 4, 64, 64] and known views [B, 4, 64, 64] -> what `split` takes apart [B, 11]."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.seen = nn.Sequential(block(7, width, stride=2), block(width, width))
        self.known = nn.Sequential(block(4, width, stride=2), block(width, width))
        self.both = nn.Sequential(normed(3 * width, 2 * width, stride=2), normed(2 * width, 2 * width),
                                  normed(2 * width, 3 * width, stride=2), normed(3 * width, 3 * width),
                                  normed(3 * width, 4 * width, stride=2), nn.Flatten(),
                                  nn.Linear(4 * width * 16, 256), nn.LeakyReLU(0.1), nn.Linear(256, OUTPUTS))

    def forward(self, seen: Tensor, known: Tensor) -> Tensor:
        rgb, mask = seen[:, :3], seen[:, 3:]
        own = self.seen(torch.cat([rgb, rgb * mask, mask], 1) - 0.25)
        other = self.known(known - 0.25)
        return self.both(torch.cat([own, other, (own - other).abs()], 1)).float()


class Compared:
    """What a comparison says of B pairs.

    `same` [B] is a logit; `shift` [B, 2] (right, down, in half crop sides) and `log_ratio` [B] say where the known view
    lies in the crop, and how much larger it is there; `turn` [B, 2] is the direction of the crop's camera in radians
    from that of the known view, to the right and up as this one sees it; `roll` [B] is in radians. The log deviations
    are those of the shift, of the log ratio, of the turn and of the roll [B, 4].
    """

    def __init__(self, raw: Tensor) -> None:
        self.same, self.shift, self.log_ratio = raw[:, 0], raw[:, 1:3], raw[:, 3]
        self.turn, self.roll = raw[:, 4:6], raw[:, 6]
        self.log_std = raw[:, 7:11].clamp(-5.0, 1.0)

    @property
    def deviation(self) -> Tensor:
        """The standard deviations [B, 4], double precision: those of Laplace distributions with the scales
        exp(log_std)."""
        return 2.0 ** 0.5 * self.log_std.exp().double()
