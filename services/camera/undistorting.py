"""Removes the distortion of a lens, in the same resampling that makes an image of the training's camera.

Each pixel of the result is a fixed sum of the image's pixels: the bilinear samples along its rays. The sums are the
rows of one sparse matrix, which is made once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from saccade.services.camera.trajectories.distortion import widest
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, Array
from saccade.shared.world.images import Size

MOST_SAMPLES = 4  # on each side of a pixel; an image of 4000 pixels needs no more, because samples are two pixels wide


class Undistorting:
    """The mapping from images of `size_px` (width, height), taken through `lens` with intrinsics for this size, to
    images of 480x480 pixels with INTRINSICS_PX. `coverage` is the share of these pixels that the images show."""

    def __init__(self, size_px: Size, lens: Lens):
        width, height = size_px
        samples = int(np.clip(np.ceil(max(lens.of(size_px)[:2]) / min(INTRINSICS_PX[:2]) - 1e-6), 1, MOST_SAMPLES))
        pixels = _shown_at(lens, samples).reshape(-1, samples ** 2, 2)
        with np.errstate(invalid="ignore"):  # where the model does not hold, the pixels are NaN
            inside = (pixels >= 0).all(2) & (pixels[..., 0] <= width) & (pixels[..., 1] <= height)
        self._seen = inside.all(1)
        self.coverage = float(self._seen.mean())
        self._rows = _bilinear(pixels[self._seen].reshape(-1, 2), size_px, samples ** 2)

    def of(self, rgb: NDArray[np.uint8], fill: int) -> NDArray[np.uint8]:
        """The image [480, 480, 3] of an image [H, W, 3]. Pixels that it does not show get the value `fill`."""
        result = np.full((IMAGE_SIZE_PX ** 2, 3), fill, dtype=np.uint8)
        seen = self._rows @ rgb.reshape(-1, 3).astype(np.float32)
        result[self._seen] = np.clip(np.rint(seen), 0, 255)
        return result.reshape(IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3)


def _shown_at(lens: Lens, samples: int) -> Array:
    """Pixels of the lens [480 * 480 * samples ** 2, 2] that belong to evenly spread samples of each pixel of the
    result. NaN where the lens shows nothing."""
    fx, fy, cx, cy = INTRINSICS_PX
    side = np.arange(IMAGE_SIZE_PX)[:, None] + (np.arange(samples) + 0.5) / samples  # [480, samples]
    x, y = (side - cx) / fx, (side - cy) / fy
    shape = (IMAGE_SIZE_PX, IMAGE_SIZE_PX, samples, samples)
    rays = np.stack([np.broadcast_to(x[None, :, None, :], shape), np.broadcast_to(y[:, None, :, None], shape)], axis=-1)
    rays = rays.reshape(-1, 2)
    known = np.linalg.norm(rays, axis=1) <= widest(dict(lens.distortion), fisheye=lens.fisheye)
    pixels = np.full(rays.shape, np.nan)
    pixels[known] = lens.pixels(rays[known])
    return pixels


def _bilinear(pixels: Array, size_px: Size, samples: int) -> csr_matrix:
    """The matrix [N, height * width] whose rows are means of bilinear samples at `pixels` [N * samples, 2]."""
    width, height = size_px
    place = np.clip(pixels - 0.5, 0, (width - 1, height - 1))  # from the centre of the first pixel
    first = np.minimum(place.astype(np.int32), (max(width - 2, 0), max(height - 2, 0)))
    share = (place - first).astype(np.float32)
    columns, weights = [], []
    for right in (0, 1):
        for down in (0, 1):
            column = np.minimum(first[:, 0] + right, width - 1)
            columns.append(np.minimum(first[:, 1] + down, height - 1) * width + column)
            weights.append((share[:, 0] if right else 1 - share[:, 0]) * (share[:, 1] if down else 1 - share[:, 1]))
    count = 4 * samples
    rows = csr_matrix((np.stack(weights, axis=1).ravel() / samples, np.stack(columns, axis=1).ravel(),
                       np.arange(0, count * (len(pixels) // samples) + 1, count)),
                      shape=(len(pixels) // samples, height * width))
    rows.sum_duplicates()
    return rows
