"""Whether an image shows an object as the goal image does, at the resolution that is there.

Latent poses hold crops of 64 pixels, and the front and the back of a label may look alike in them. So the goal's object
is also compared by local features (`local_features.py`), where the goal's view may be: where it is about as large and
about at the same place in the image. Features of both crops that are alike belong together, and in views from the same
direction nearly all of these pairs follow from one affine map that is not far from the identity. Laid over each other
by this map, the crops must have the same colours (`colours.py`), which local features do not see.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from saccade.services.perception.colours import unlike
from saccade.services.perception.cropping import Cropper
from saccade.services.perception.local_features import Features, LocalFeatures, mutual
from saccade.services.perception.seen import Seen
from saccade.shared.bus.messages import mask_of
from saccade.shared.world.geometry import pixel_rays, unit
from saccade.shared.world.windows import Window

SIDE_PX = 256  # of the crops that are compared
MOST = 400  # local features of a crop
SHOWN = 0.5  # chosen: objects with a lower presence are not compared
ASIDE_RAD, LARGER = 0.15, 0.25  # chosen: how far from the goal's place, and by what logarithm larger, an object may be
MARGIN_PX = 4  # chosen: features within this of the object's mask are its own
FEWEST = 3  # pairs that tell an affine map
SHIFTED = 0.12  # chosen: pairs that begin are shifted like their median, to this share of the crop's side
FROM_ABOVE = 0.75  # chosen: sine of the elevation from which on the turn tells the azimuth, and not the shift
SHIFT_PER_RAD = 0.12  # measured: how far a surface shifts in its crop, in crop sides
USUAL, UNLIKE = 0.05, 0.1  # of colours in views from one direction, and how much more takes the e-th part of the share
WITHIN = (0.08, 0.05, 0.03, 0.02, 0.02)  # chosen: the same for pairs that follow the map, from fit to fit


class Agreement(NamedTuple):
    """The share (0 to 1) of an object's local features that agree, of those in the crop that has fewer, less where
    colours do not, and by how much larger than here the azimuth of the goal's view must be."""

    share: float
    aside_rad: float


class Shown(NamedTuple):
    """An object as an image shows it: its crop with its mask [4, S, S], and the local features in the mask."""

    crop: Tensor
    features: Features


class SameView:
    """Compares images with one goal image, in which objects with crops of `sides_m` [K] (metres) were `seen`.

    Raises SaccadeError if the local features cannot be had.
    """

    def __init__(self, features: LocalFeatures, sides_m: ArrayLike, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike,
                 up: ArrayLike, seen: Seen, rows: Sequence[int] | None = None):
        self._rows = range(len(seen.presence)) if rows is None else rows  # of the goal's objects in `seen`
        self._features, self._sides_m = features, np.asarray(sides_m, dtype=np.float64)
        self._intrinsics_px, self._seen = np.asarray(intrinsics_px), seen
        self._shown = {k: self._of(k, row, rgb, intrinsics_px, up, seen)
                       for k, row in enumerate(self._rows) if seen.presence[row] > SHOWN}

    def __call__(self, k: int, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
                 seen: Seen, row: int | None = None) -> Agreement | None:
        """How an image [H, W, 3] agrees with the goal image on object `k`, which is the row `row` (by default `k`) of
        what is `seen`. None if they are not compared."""
        row = k if row is None else row
        if k not in self._shown or seen.presence[row] < SHOWN or not self._may_be_same(k, row, intrinsics_px, seen):
            return None
        there, here = self._shown[k], self._of(k, row, rgb, intrinsics_px, up, seen)
        fewer = min(len(there.features.pixels), len(here.features.pixels))
        if fewer < FEWEST:
            return None
        rows, columns = mutual((there.features.descriptors @ here.features.descriptors.T).numpy())
        count, affine = following(*((each.double().numpy() / SIDE_PX) for each in
                                    (there.features.pixels[rows], here.features.pixels[columns])))
        more = max(unlike(there.crop, here.crop, affine) - USUAL, 0.0) if count else 0.0
        return Agreement(count / fewer * float(np.exp(-more / UNLIKE)),
                         aside_of(affine, intrinsics_px, up, seen.pixel[row]))

    def _may_be_same(self, k: int, row: int, intrinsics_px: ArrayLike, seen: Seen) -> bool:
        here, there = (unit(pixel_rays(one.pixel[at], px)) for one, px, at in
                       ((seen, intrinsics_px, row), (self._seen, self._intrinsics_px, self._rows[k])))
        larger = np.log(seen.scale[row] / self._seen.scale[self._rows[k]])
        return bool(here @ there > np.cos(ASIDE_RAD) and abs(larger) < LARGER)

    @torch.inference_mode()
    def _of(self, k: int, row: int, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            seen: Seen) -> Shown:
        """Object `k`, the row `row` of what is `seen`, as an image shows it."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        mask = torch.from_numpy(mask_of(seen.mask_bits[row])).float()[None]
        cropper = Cropper(image, mask, intrinsics_px, up)
        window = Window(seen.pixel[row, None], seen.scale[row, None], self._sides_m[k, None])
        crop, own_mask = cropper.fine_masked(window, SIDE_PX)
        found, own = self._features(crop, MOST)[0], _widened(own_mask[0])
        column, row = found.pixels.long().clamp(0, SIDE_PX - 1).T
        inside = own[row, column]
        return Shown(torch.cat([crop[0], own_mask]), Features(found.pixels[inside], found.descriptors[inside]))


def _widened(mask: Tensor) -> Tensor:
    """Where a mask [S, S] holds or is near (truth values)."""
    side = 2 * MARGIN_PX + 1
    return torch.nn.functional.max_pool2d(mask[None], side, 1, MARGIN_PX)[0] > 0.3


def following(there: NDArray[np.float64], here: NDArray[np.float64]) -> tuple[int, NDArray[np.float64]]:
    """How many pairs of places [M, 2] in two crops (shares of the side) follow from one affine map, and the map [3, 2].

    It is fitted anew to those that follow it, beginning with those that are shifted alike. If there are too few, it is
    the identity, and none follows it.
    """
    if len(there) < FEWEST:
        return 0, np.eye(3, 2)
    places, shift = np.column_stack([there, np.ones(len(there))]), here - there
    follow = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < SHIFTED
    for within in WITHIN:
        if follow.sum() < FEWEST:
            return 0, np.eye(3, 2)
        affine = np.linalg.lstsq(places[follow], here[follow], rcond=None)[0]
        follow = np.linalg.norm(places @ affine - here, axis=1) < within
    return int(follow.sum()), affine


def aside_of(affine: NDArray[np.float64], intrinsics_px: ArrayLike, up: ArrayLike, pixel: ArrayLike) -> float:
    """By how much larger than here (rad) the azimuth of the view must be from which an object, seen at a pixel [2] by a
    camera in which `up` [3] is up, looks as in the goal image.

    Around an object that is seen from above, another azimuth turns the image; seen from the side, it shifts the
    surface aside.
    """
    down = -float(unit(pixel_rays(pixel, intrinsics_px)) @ np.asarray(up, dtype=np.float64))
    if down > FROM_ABOVE:
        return -roll_of(affine) / down
    return float(affine[:2, 0] @ (0.5, 0.5) + affine[2, 0] - 0.5) / SHIFT_PER_RAD


def roll_of(affine: NDArray[np.float64]) -> float:
    """The angle (rad) by which an affine map [3, 2] of places (right, down) turns things to the right."""
    (xx, xy), (yx, yy) = affine[:2]
    return float(np.arctan2(xy - yx, xx + yy))
