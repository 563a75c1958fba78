"""Fits photographs to what networks take, and brings what they found back into the photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from saccade.shared.world.geometry import IMAGE_SIZE_PX
from saccade.shared.world.images import Size
from saccade.shared.world.photographs import Intrinsics, Photograph, scaled

LONGEST_PX = 1280  # more pixels tell networks no more about things that are large enough to be recognised
SQUARE_PX = (IMAGE_SIZE_PX, 2 * IMAGE_SIZE_PX)  # limits of the side of a square; networks for squares know the first


@dataclass(frozen=True)
class Fitted:
    """A photograph as networks take it: `rgb` [H, W, 3] with `intrinsics_px`. The photograph fills `inner_px` (width,
    height) of it, from `corner_px`; the rest is black. `size_px` is the photograph's own size."""

    rgb: NDArray[np.uint8]
    intrinsics_px: Intrinsics
    corner_px: tuple[int, int]
    inner_px: Size
    size_px: Size

    def back(self, pixel: ArrayLike) -> tuple[float, float]:
        """The pixel (u, v) of the photograph at a pixel of `rgb`."""
        u, v = (np.asarray(pixel, dtype=np.float64) - self.corner_px) * self.size_px / self.inner_px
        return float(u), float(v)

    def cells(self, cells: int, size_px: Size) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Which rows [H] and columns [W] of a grid of cells x cells over `rgb` the pixels of the photograph lie in, if
        it is shown in the size (width, height)."""
        (columns, rows) = (
            ((np.arange(count) + 0.5) / count * inner + corner) / side * cells for count, inner, corner, side in
            zip(size_px, self.inner_px, self.corner_px, self.rgb.shape[1::-1], strict=True))
        return rows.astype(np.int64), columns.astype(np.int64)


def fitted(photo: Photograph, *, square: bool) -> Fitted:
    """The photograph for networks that take any size, or put into the middle of a black square."""
    size_px = photo.rgb.shape[1], photo.rgb.shape[0]
    if not square:
        return Fitted(photo.rgb, photo.intrinsics_px, (0, 0), size_px, photo.size_px)
    side = int(np.clip(max(size_px), *SQUARE_PX))
    width, height = inner_px = round(size_px[0] * side / max(size_px)), round(size_px[1] * side / max(size_px))
    left, top = corner_px = (side - width) // 2, (side - height) // 2
    rgb = np.zeros((side, side, 3), dtype=np.uint8)
    picture = Image.fromarray(photo.rgb)
    rgb[top:top + height, left:left + width] = np.asarray(
        picture if inner_px == size_px else picture.resize(inner_px, Image.Resampling.BILINEAR))
    fx, fy, cx, cy = scaled(photo.intrinsics_px, size_px, inner_px)
    return Fitted(rgb, (fx, fy, cx + left, cy + top), corner_px, inner_px, photo.size_px)


def run_lengths(grid: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> list[int]:
    """The run lengths of the mask grid[rows][:, columns] as COCO counts them: down the first column, then down the
    second, and so on; the first run is of pixels outside of the mask, and may be 0.

    The mask itself, which may have millions of pixels, is not made.
    """
    height, total = len(rows), len(rows) * len(columns)
    edges = np.diff(np.pad(grid[rows].astype(np.int8), ((1, 1), (0, 0))), axis=0) != 0  # [H + 1, cells]
    changes = [np.flatnonzero(edge) for edge in edges.T]
    places = [column * height + changes[cell] for column, cell in enumerate(columns)]
    place, times = np.unique(np.concatenate(places), return_counts=True)
    kept = place[times == 1]  # where one column ends and the next begins within the mask, nothing changes
    lengths = np.diff(np.concatenate([[0], kept, [] if len(kept) and kept[-1] == total else [total]]))
    return [int(length) for length in lengths]
