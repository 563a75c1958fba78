"""Turns images of one pinhole camera into images that the camera of the training would have seen from the same pose.

Two pinhole cameras with the same centre see the same rays, so their images differ by a homography, K' K^-1, for any
scene. If both have the same attitude and no skew, this homography is a scale and a shift of each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.images import Size

_ROUNDING_PX = 1e-6


@dataclass(frozen=True)
class _Axis:
    """One axis of the mapping: output pixels [first, last) show the image from `start` to `end` (image pixels)."""

    first: int
    last: int
    start: float
    end: float

    @property
    def count(self) -> int:
        return max(0, self.last - self.first)


def _axis(length_px: int, focal: float, center: float, trained_focal: float, trained_center: float) -> _Axis:
    step = focal / trained_focal  # image pixels per output pixel
    origin = center - trained_center * step  # the start of the output, in image pixels
    first = max(0, int(np.ceil(-origin / step - _ROUNDING_PX)))
    last = min(IMAGE_SIZE_PX, int(np.floor((length_px - origin) / step + _ROUNDING_PX)))
    return _Axis(first, last, max(0.0, origin + first * step), min(float(length_px), origin + last * step))


class Resampling:
    """The mapping from images of `size_px` (width, height) with `intrinsics_px` (fx, fy, cx, cy) to images of 480x480
    pixels with INTRINSICS_PX. `coverage` is the share of these pixels that the images show."""

    def __init__(self, size_px: Size, intrinsics_px: Sequence[float]):
        (width, height), (fx, fy, cx, cy) = size_px, intrinsics_px
        trained_fx, trained_fy, trained_cx, trained_cy = INTRINSICS_PX
        self._u = _axis(width, fx, cx, trained_fx, trained_cx)
        self._v = _axis(height, fy, cy, trained_fy, trained_cy)
        self.coverage = self._u.count * self._v.count / IMAGE_SIZE_PX ** 2

    def of(self, rgb: NDArray[np.uint8], fill: int) -> NDArray[np.uint8]:
        """The image [480, 480, 3] of an image [H, W, 3]. Pixels that it does not show get the value `fill`."""
        result = np.full((IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3), fill, dtype=np.uint8)
        u, v = self._u, self._v
        if u.count and v.count:
            seen = Image.fromarray(rgb).resize((u.count, v.count), Image.Resampling.BILINEAR,
                                               box=(u.start, v.start, u.end, v.end))
            result[v.first:v.last, u.first:u.last] = np.asarray(seen)
        return result
