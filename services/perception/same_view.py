"""Whether an image shows an object as the goal image does, at the resolution that is there.

Latent poses hold crops of 64 pixels, and the front and the back of a label may look alike in them. So the goal's object
is also compared by local features (`local_features.py`), where the goal's view may be: where it is about as large and
about at the same place in the image. Features of both crops that are alike belong together, and in views from the same
direction nearly all of these pairs follow from a smooth map that is not far from the identity: each is shifted as an
affine map tells that is fitted to the pairs near it, so that the faces of a box may each be shifted in their way. Laid
over each other, the crops must have the same colours (`colours.py`), which local features do not see. How the surface
is shifted as a whole tells where the goal's view is.
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
# Chosen: how far from the goal's place, and by what logarithm larger, an object may be. Of an object that is cut off by
# the border of an image the networks tell the size badly.
ASIDE_RAD, LARGER = 0.15, 0.5
MARGIN_PX = 4  # chosen: features within this of the object's mask are its own
FEWEST = 6  # pairs that tell a map
SHIFTED = 0.2  # chosen: pairs that begin are shifted like their median, to this share of the crop's side
NEAR, RIDGE, FELLOWS = 0.12, 1e-3, 1.0  # chosen: what is near a pair (crop sides), and how much of it must follow, too
WITHIN = (0.08, 0.06, 0.05, 0.04, 0.03)  # chosen: the same for pairs that follow the map, from fit to fit
FROM_ABOVE = 0.93  # chosen: sine of the elevation from which on the turn alone tells the azimuth
# Fitted to 800 views of ten objects within 0.45 rad of the goal's direction: what a shift to the right and a turn say
# of the way around the object, and what a shift downwards and a larger image say of the way up.
AROUND_OF_SHIFT, AROUND_OF_TURN, UP_OF_SHIFT, UP_OF_SIZE = 3.8, -0.6, -3.2, 0.5
USUAL, UNLIKE = 0.1, 0.2  # of colours in views from one direction, and how much more takes the e-th part of the share
# Of a goal image nothing is known but that it stands upright. Images are compared with it as they are, so that to a
# camera that is rolled things look unlike.
GOAL_UP = (0.0, 1.0, 0.0)


class Agreement(NamedTuple):
    """The share (0 to 1) of an object's local features that agree, of those in the crop that has fewer, less where
    colours do not; by how much larger than here azimuth and elevation of the goal's view must be; and the logarithm of
    how much larger the object is here than the networks say, against the goal image."""

    share: float
    aside_rad: float
    above_rad: float
    log_larger: float


class Shown(NamedTuple):
    """An object as an image shows it: its crop with its mask [4, S, S], and the local features in the mask."""

    crop: Tensor
    features: Features


class SameView:
    """Compares images with one goal image, in which objects with crops of `sides_m` [K] (metres) were `seen`.

    Raises SaccadeError if the local features cannot be had.
    """

    def __init__(self, features: LocalFeatures, sides_m: ArrayLike, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike,
                 seen: Seen, rows: Sequence[int] | None = None):
        self._rows = range(len(seen.presence)) if rows is None else rows  # of the goal's objects in `seen`
        self._features, self._sides_m = features, np.asarray(sides_m, dtype=np.float64)
        self._intrinsics_px, self._seen = np.asarray(intrinsics_px), seen
        self._shown = {k: self._of(k, row, rgb, intrinsics_px, seen)
                       for k, row in enumerate(self._rows) if seen.presence[row] > SHOWN}

    def __call__(self, k: int, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
                 seen: Seen, row: int | None = None) -> Agreement | None:
        """How an image [H, W, 3] agrees with the goal image on object `k`, which is the row `row` (by default `k`) of
        what is `seen`. None if they are not compared."""
        row = k if row is None else row
        if k not in self._shown or seen.presence[row] < SHOWN or not self._may_be_same(k, row, intrinsics_px, seen):
            return None
        there, here = self._shown[k], self._of(k, row, rgb, intrinsics_px, seen)
        fewer = min(len(there.features.pixels), len(here.features.pixels))
        if fewer < FEWEST:
            return None
        rows, columns = mutual((there.features.descriptors @ here.features.descriptors.T).numpy())
        count, affine = following(*((each.double().numpy() / SIDE_PX) for each in
                                    (there.features.pixels[rows], here.features.pixels[columns])))
        more = max(unlike(there.crop, here.crop, affine) - USUAL, 0.0) if count else 0.0
        sine = -float(unit(pixel_rays(seen.pixel[row], intrinsics_px)) @ np.asarray(up, dtype=np.float64))
        return Agreement(count / fewer * float(np.exp(-more / UNLIKE)), *way_to_goal(affine, sine), size_of(affine))

    def _may_be_same(self, k: int, row: int, intrinsics_px: ArrayLike, seen: Seen) -> bool:
        here, there = (unit(pixel_rays(one.pixel[at], px)) for one, px, at in
                       ((seen, intrinsics_px, row), (self._seen, self._intrinsics_px, self._rows[k])))
        larger = np.log(seen.scale[row] / self._seen.scale[self._rows[k]])
        return bool(here @ there > np.cos(ASIDE_RAD) and abs(larger) < LARGER)

    def _others(self, row: int, seen: Seen) -> NDArray[np.bool_]:
        """Where the masks [M, M] of other things than a row's hold: what they hide may be taken for a part of it."""
        others = [mask_of(seen.mask_bits[other]) for other in np.flatnonzero(seen.presence > SHOWN) if other != row]
        return np.any(others, axis=0) if others else np.zeros(seen.mask_bits.shape[1:2] * 2, dtype=bool)

    @torch.inference_mode()
    def _of(self, k: int, row: int, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, seen: Seen) -> Shown:
        """Object `k`, the row `row` of what is `seen`, as an image shows it."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        mask = torch.from_numpy(mask_of(seen.mask_bits[row]) & ~self._others(row, seen)).float()[None]
        cropper = Cropper(image, mask, intrinsics_px, GOAL_UP)
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
    """How many pairs of places [M, 2] in two crops (shares of the side) follow from one smooth map, and the affine map
    [3, 2] that fits these best.

    The map is affine near each pair. It is fitted anew to those that follow it, beginning with those that are shifted
    alike. If there are too few, the affine map is the identity, and none follows it.
    """
    if len(there) < FEWEST:
        return 0, np.eye(3, 2)
    places, shift = np.column_stack([there, np.ones(len(there))]), here - there
    nearness = np.exp(-((there[:, None] - there) ** 2).sum(-1) / (2 * NEAR ** 2)) - np.eye(len(there))
    products = (places[:, :, None] * places[:, None]).reshape(-1, 9)
    shifted = (places[:, :, None] * shift[:, None]).reshape(-1, 6)
    follow = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < SHIFTED
    for within in WITHIN:
        if follow.sum() < FEWEST:
            return 0, np.eye(3, 2)
        weights = nearness * follow
        moments = (weights @ products).reshape(-1, 3, 3) + RIDGE * np.eye(3)
        maps = np.linalg.solve(moments, (weights @ shifted).reshape(-1, 3, 2))
        follow = np.linalg.norm((places[:, None] @ maps)[:, 0] - shift, axis=1) < within
    follow &= (nearness * follow).sum(1) > FELLOWS
    if follow.sum() < FEWEST:
        return 0, np.eye(3, 2)
    return int(follow.sum()), np.linalg.lstsq(places[follow], here[follow], rcond=None)[0]


def way_to_goal(affine: NDArray[np.float64], sine: float) -> tuple[float, float]:
    """By how much larger than here (rad) azimuth and elevation of the view must be from which an object looks as in the
    goal image. `sine` is that of the elevation here.

    Around an object that is seen from above, another azimuth turns the image; seen from the side, it shifts the
    surface aside. Another elevation shifts it up or down.
    """
    right, down = affine[:2].T @ (0.5, 0.5) + affine[2] - 0.5
    above = UP_OF_SHIFT * down + UP_OF_SIZE * size_of(affine)
    if sine > FROM_ABOVE:
        return -roll_of(affine) / sine, float(above)
    around = AROUND_OF_SHIFT * right + AROUND_OF_TURN * roll_of(affine)
    return float(around / np.sqrt(1.0 - min(sine ** 2, FROM_ABOVE ** 2))), float(above)


def size_of(affine: NDArray[np.float64]) -> float:
    """The logarithm of how much larger things are after an affine map [3, 2]."""
    return float(np.log(max(abs(np.linalg.det(affine[:2])), 1e-6))) / 2


def roll_of(affine: NDArray[np.float64]) -> float:
    """The angle (rad) by which an affine map [3, 2] of places (right, down) turns things to the right."""
    (xx, xy), (yx, yy) = affine[:2]
    return float(np.arctan2(xy - yx, xx + yy))
