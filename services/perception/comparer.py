"""The comparer: a crop and a known view of an object side by side. Are they the same thing, and what lies between them?

The view encoder proposes which views may be meant; the comparer looks at both pictures at once. So it sees what a
vector cannot hold: the small differences between near twins, and by how much the crop is off.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.services.perception.networks import block, normed

OUTPUTS = 11


class Half(NamedTuple):
    """What the comparer makes of one of two pictures: maps [B, W, 32, 32], and what they alone give to the first layer
    that sees both [B, 2 W, 16, 16]."""

    maps: Tensor
    given: Tensor


class Comparison(nn.Module):
    """Crops with their masks [B, 4, 64, 64] and known views [B, 4, 64, 64] -> what `split` takes apart [B, 11].

    A crop that is compared with many views is looked at once: see `of_seen`, `of_known` and `halves`.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.seen = nn.Sequential(block(7, width, stride=2), block(width, width))
        self.known = nn.Sequential(block(4, width, stride=2), block(width, width))
        self.both = nn.Sequential(normed(3 * width, 2 * width, stride=2), normed(2 * width, 2 * width),
                                  normed(2 * width, 3 * width, stride=2), normed(3 * width, 3 * width),
                                  normed(3 * width, 4 * width, stride=2), nn.Flatten(),
                                  nn.Linear(4 * width * 16, 256), nn.LeakyReLU(0.1), nn.Linear(256, OUTPUTS))

    def forward(self, seen: Tensor, known: Tensor) -> Tensor:
        own, other = self._seen(seen), self.known(known - 0.25)
        return self.both(torch.cat([own, other, (own - other).abs()], 1)).float()

    def _seen(self, seen: Tensor) -> Tensor:
        rgb, mask = seen[:, :3], seen[:, 3:]
        return self.seen(torch.cat([rgb, rgb * mask, mask], 1) - 0.25)

    def of_seen(self, seen: Tensor) -> Half:
        """The half of crops [B, 4, 64, 64]."""
        return self._half(self._seen(seen), 0)

    def of_known(self, known: Tensor) -> Half:
        """The half of known views [B, 4, 64, 64]."""
        return self._half(self.known(known - 0.25), 1)

    def halves(self, seen: Half, known: Half) -> Tensor:
        """What `forward` says, up to rounding: the first layer is linear, so that it takes each half by itself, and
        their difference."""
        together = self._first((seen.maps - known.maps).abs(), 2, self._layer.bias) + seen.given + known.given
        return self.both[1:](self._normed[1:](together)).float()

    def _half(self, maps: Tensor, number: int) -> Half:
        return Half(maps, self._first(maps, number, None))

    def _first(self, maps: Tensor, number: int, bias: Tensor | None) -> Tensor:
        """The first layer, of the third with this number of its inputs."""
        width = maps.shape[1]
        weight = self._layer.weight[:, number * width:(number + 1) * width]
        return F.conv2d(maps, weight, bias, self._layer.stride, self._layer.padding)

    @property
    def _normed(self) -> nn.Sequential:
        first = self.both[0]
        assert isinstance(first, nn.Sequential)
        return first

    @property
    def _layer(self) -> nn.Conv2d:
        layer = self._normed[0]
        assert isinstance(layer, nn.Conv2d)
        return layer


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
