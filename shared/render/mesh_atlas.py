"""Brings the textures and colours of several parts into one texture, an atlas, with new texture coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.render.mesh import TEXTURE_MAX_PX
from saccade.shared.render.mesh_parts import Part

MOST_REPEATS = 4  # of a texture within one face; what repeats it more often is drawn with a coarser pattern
PLAIN_PX = 8  # side of the patch of one colour
BLEND_PX = 6  # side of the patch of a face whose corners have different colours
_MARGIN_PX = 8  # around a texture, filled with its edge, because distant views mix neighbouring texels
_SMALLER = 0.85
_NEAR = 1e-6


@dataclass(frozen=True)
class _Block:
    """A rectangle of the atlas, and where the corners of faces are in it.

    It has texels [H, W, 3] and, for the faces with these numbers, texels' coordinates xy [F, 3, 2] (y points down).
    """

    texels: NDArray[np.uint8]
    faces: NDArray[np.int64]
    xy: NDArray[np.float64]


def baked(parts: list[Part]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Texture coordinates [F, 3, 2] (v points up) of the faces of all parts, one after the other, and the one texture
    [H, W, 3] of at most TEXTURE_MAX_PX in width and height. Raises ValueError if that is too small."""
    wrapped = [None if part.uv is None else _wrapped(part.uv) for part in parts]
    first = parts[0].image
    if first is not None and all(part.image is first for part in parts):
        uv = np.concatenate([own for own in wrapped if own is not None])
        if uv.max() <= 1.0 + _NEAR:
            return uv, np.asarray(first)
    scale = 1.0
    while scale > 0.02:
        blocks = [*_image_blocks(parts, wrapped, scale), *_colour_blocks(parts, scale)]
        if (places := _packed([block.texels.shape[:2] for block in blocks])) is not None:
            return _assembled(blocks, *places, sum(len(part.corners) for part in parts))
        scale *= _SMALLER
    raise ValueError("it has too many textures and colours")


def _wrapped(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same texture coordinates [F, 3, 2] from 0 on: a face that leaves the image from 0 to 1 is moved by whole
    images, so that it begins in it. It may still end beyond 1."""
    low, high = uv.min(1, keepdims=True), uv.max(1, keepdims=True)
    outside = (low < -_NEAR) | (high > 1.0 + _NEAR)
    uv = np.where(outside, uv - np.floor(low + _NEAR), uv)
    high = uv.max(1, keepdims=True)
    return np.maximum(np.where(high > MOST_REPEATS, uv * (MOST_REPEATS / np.maximum(high, 1.0)), uv), 0.0)


def _starts(parts: list[Part]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum([len(part.corners) for part in parts])])


def _image_blocks(parts: list[Part], wrapped: list[NDArray[np.float64] | None], scale: float) -> list[_Block]:
    """One block for each image, in which it is repeated as often as a face needs."""
    uses: dict[int, list[int]] = {}
    for number, part in enumerate(parts):
        if part.image is not None:
            uses.setdefault(id(part.image), []).append(number)
    starts, blocks = _starts(parts), []
    for numbers in uses.values():
        image = parts[numbers[0]].image
        uv = np.concatenate([own for number in numbers if (own := wrapped[number]) is not None])
        repeats = np.maximum(np.ceil(uv.max((0, 1)) - _NEAR), 1).astype(int)
        most = (TEXTURE_MAX_PX - 2 * _MARGIN_PX) * scale / repeats
        assert image is not None
        wide, high = (max(1, int(min(side * scale, limit))) for side, limit in zip(image.size, most, strict=True))
        small = image if image.size == (wide, high) else image.resize((wide, high), Image.Resampling.BOX)
        tiled = np.tile(np.asarray(small), (repeats[1], repeats[0], 1))
        texels = np.pad(tiled, ((_MARGIN_PX, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (0, 0)), mode="edge")
        xy = _MARGIN_PX + np.stack([uv[..., 0] * wide, (repeats[1] - uv[..., 1]) * high], axis=-1)
        faces = np.concatenate([np.arange(starts[number], starts[number + 1]) for number in numbers])
        blocks.append(_Block(texels, faces, xy))
    return blocks


def _colour_blocks(parts: list[Part], scale: float) -> list[_Block]:
    """A block with a patch for each colour of whole faces, and one with a patch for each face that blends colours."""
    starts = _starts(parts)
    numbers = [number for number, part in enumerate(parts) if part.colours is not None]
    if not numbers:
        return []
    faces = np.concatenate([np.arange(starts[number], starts[number + 1]) for number in numbers])
    colours = np.concatenate([own for number in numbers if (own := parts[number].colours) is not None])
    plain = (colours == colours[:, :1]).all((1, 2))
    blocks = []
    if plain.any():
        different, inverse = np.unique(colours[plain, 0], axis=0, return_inverse=True)
        side, places = _grid(len(different), PLAIN_PX, scale)
        patches = np.broadcast_to(different[:, None, None], (len(different), side, side, 3))
        middle = (places[inverse.ravel()] + side / 2)[:, None]
        blocks.append(_Block(_laid_out(patches), faces[plain], np.repeat(middle, 3, axis=1)))
    if not plain.all():
        corners = colours[~plain]
        side, places = _grid(len(corners), BLEND_PX, scale)
        patches, within = _blended(corners, side)
        blocks.append(_Block(_laid_out(patches), faces[~plain], places[:, None] + within))
    return blocks


def _grid(count: int, side: int, scale: float) -> tuple[int, NDArray[np.float64]]:
    """The side of each of so many patches, and their top left corners [count, 2] in a square block."""
    columns = math.ceil(math.sqrt(count))
    side = max(2, min(int(side * scale), TEXTURE_MAX_PX // columns))
    numbers = np.arange(count)
    return side, side * np.stack([numbers % columns, numbers // columns], axis=-1).astype(np.float64)


def _laid_out(patches: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Patches [N, S, S, 3] in rows of a square image."""
    count, side = patches.shape[:2]
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    filled = np.zeros((rows * columns, side, side, 3), dtype=np.uint8)
    filled[:count] = patches
    return filled.reshape(rows, columns, side, side, 3).swapaxes(1, 2).reshape(rows * side, columns * side, 3)


def _blended(colours: NDArray[np.uint8], side: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Patches [F, S, S, 3] that go from one corner's colour [F, 3, 3] to the others', and where the corners are in them
    [3, 2]."""
    start = min(1.5, side / 2 - 0.5)
    length = max(side - 2 * start, 1.0)
    along = np.clip((np.arange(side) + 0.5 - start) / length, 0.0, 1.0)
    right, down = np.meshgrid(along, along)
    beyond = np.maximum(right + down, 1.0)  # beyond the triangle its edge's colour goes on
    shares = np.stack([1.0 - (right + down) / beyond, right / beyond, down / beyond], axis=-1)
    patches = np.einsum("hwk,fkc->fhwc", shares, colours.astype(np.float32))
    within = np.array([[start, start], [start + length, start], [start, start + length]])
    return np.clip(patches.round(), 0, 255).astype(np.uint8), within


def _packed(sizes: list[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int, int] | None:
    """Places (x, y) of rectangles (height, width) in rows, and the height and width of all. None if they do not fit."""
    area = sum(high * wide for high, wide in sizes)
    for width in (max(*(wide for _, wide in sizes), math.ceil(1.1 * math.sqrt(area)), 1), TEXTURE_MAX_PX):
        places, x, y, row = [(0, 0)] * len(sizes), 0, 0, 0
        for number in sorted(range(len(sizes)), key=lambda number: -sizes[number][0]):
            high, wide = sizes[number]
            if x + wide > width:
                x, y, row = 0, y + row, 0
            places[number] = (x, y)
            x, row = x + wide, max(row, high)
        if width <= TEXTURE_MAX_PX and y + row <= TEXTURE_MAX_PX:
            return places, y + row, width
    return None


def _assembled(blocks: list[_Block], places: list[tuple[int, int]], high: int, wide: int,
               count: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    texture, uv = np.zeros((high, wide, 3), dtype=np.uint8), np.zeros((count, 3, 2))
    for block, (x, y) in zip(blocks, places, strict=True):
        texture[y:y + block.texels.shape[0], x:x + block.texels.shape[1]] = block.texels
        uv[block.faces] = (block.xy + np.array([x, y])) / (wide, high)
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv, texture
