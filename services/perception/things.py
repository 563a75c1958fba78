"""What is proposed in an image, and what is found there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.cropping import warp
from saccade.services.perception.landmark_fit import Fit
from saccade.shared.world.windows import Window

FINE_PX = 256  # side of the crops in which local features are found


@dataclass(frozen=True)
class Things:
    """P things that were proposed: their crops with masks [P, 4, 64, 64] and the windows of these, finer crops without
    masks [P, 3, 256, 256], and their masks in the image [P, h, w]. The crops are rolled by the angles `roll` [P]
    (rad). The last thing may be the `whole` image."""

    crops: Tensor
    fine: Tensor
    window: Window
    masks: Tensor
    roll: NDArray[np.float64]
    whole: bool = False


@dataclass(frozen=True)
class Match:
    """An object found in a thing: the number of the thing, the probability, the view of its bank that was compared, the
    row of the comparison, and how its landmarks fit, if they do."""

    thing: int
    presence: float
    view: int
    row: int
    fit: Fit | None


def rolled(crops: Tensor, angle: Tensor) -> Tensor:
    """Crops [P, C, S, S], turned by angles [P] (rad)."""
    return warp(crops, torch.zeros(len(crops), 2), torch.ones(len(crops)), angle, crops.shape[-1])
