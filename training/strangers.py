"""Strangers: objects that no network knows. They are shapes and textures made by code, or recoloured known objects.

A network that is trained on known objects only takes everything in front of the background for the most similar known
object. Strangers teach it that an object may be unknown, in a scene and in a goal image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.render.views import TILE_PX, ObjectViews
from saccade.shared.world.geometry import REFERENCE_RANGE_M, fibonacci_hemisphere

Array = NDArray[np.float64]

KEY = 1  # key of their random numbers
CROP_SIDE_M = 0.25
SIZE_M = np.array([0.12, 0.12, 0.14])
OTHER_COLOUR = 0.12  # a known object in other colours is a stranger if they differ by more than this on average


def strangers(known: list[ObjectViews], seed: int, count: int = 600) -> ObjectViews:
    """Tiles of `count` strangers, in the form of views of one object from 0.40 m.

    A third of them have the shape of a known object. A third of these have its texture in other colours.
    """
    rng = np.random.default_rng([seed, KEY])
    azimuth, elevation = fibonacci_hemisphere(count)
    tiles = np.stack([_tile(known, rng) for _ in range(count)])[None]
    return ObjectViews("stranger", tiles, (REFERENCE_RANGE_M,), azimuth, elevation, CROP_SIDE_M, SIZE_M)


def texture(rng: np.random.Generator, side_px: int) -> Array:
    """A random texture [side_px, side_px, 3] in [0, 1]: packaging, bands of colours, a mosaic, clouds or noise.

    Some of them have little contrast.
    """
    kind = rng.choice(5, p=(0.2, 0.1, 0.1, 0.1, 0.5))
    if kind == 4:
        return _packaging(rng, side_px)
    strength = 1.0 if rng.random() < 0.7 else rng.random()
    return rng.random(3) * (1 - strength) + strength * _pattern(rng, side_px, kind)


def _pattern(rng: np.random.Generator, side_px: int, kind: int) -> Array:
    if kind == 0:
        x, _ = _plane(rng, side_px)
        bands = rng.random((int(rng.integers(1, 9)), 3))
        repeats = rng.choice([1, 1, 4])
        place = ((x + 1.5) / 3 * len(bands) * repeats).astype(int) % len(bands)
        return bands[place]
    cells = int(rng.integers(2, 9)) if kind < 3 else side_px // int(rng.integers(1, 5))
    grid = rng.random((cells + 1, cells + 1, 3))
    return _enlarged(grid, side_px, smooth=kind == 2)


def _packaging(rng: np.random.Generator, side_px: int) -> Array:
    """A texture [side_px, side_px, 3] like a package: shapes, bands and rows of print in few colours, shaded."""
    axis = (np.arange(side_px) + 0.5) / side_px * 2 - 1
    x, y = np.meshgrid(axis, axis)
    palette = rng.random((4, 3)) ** rng.uniform(0.5, 2.0)
    image = np.broadcast_to(palette[0], (side_px, side_px, 3)).copy()
    for colour in palette[1:1 + rng.integers(4)]:
        center, half = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.08, 0.6, 2)
        if rng.random() < 0.4:
            half[0] = 2.0  # a band over the whole width
        u, v = (x - center[0]) / half[0], (y - center[1]) / half[1]
        image[np.hypot(u, v) < 1 if rng.random() < 0.3 else np.maximum(np.abs(u), np.abs(v)) < 1] = colour
    for _ in range(rng.integers(5)):
        height, left, top = rng.uniform(0.02, 0.15), rng.uniform(-0.7, 0.2), rng.uniform(-0.8, 0.8)
        letters = rng.random(64)[((x + 1) / (0.8 * height)).astype(int) % 64] < 0.6
        row = (np.abs(y - top) < height) & (x > left) & (x < left + rng.uniform(0.2, 1.0))
        image[letters & row] = rng.choice(palette)
    shade = 1 + rng.uniform(-0.35, 0.35) * x + rng.uniform(-0.15, 0.15) * y
    return (image * shade[..., None] * rng.uniform(0.6, 1.0)).clip(0, 1)


def _tile(known: list[ObjectViews], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A tile [T, T, 4] uint8 of a random stranger: RGB, premultiplied by the coverage, and the coverage."""
    pick = rng.random()
    if pick < 1 / 3:
        views = known[rng.integers(len(known))]
        tile = views.tiles[rng.integers(len(views.tiles)), rng.integers(len(views.azimuth_rad))] / 255.0
        alpha = tile[..., 3:]
        rgb = recoloured(tile[..., :3], alpha, rng) if pick < 1 / 9 else texture(rng, TILE_PX)
    else:
        alpha, rgb = _shape(rng)[..., None], texture(rng, TILE_PX)
        if rng.random() < 0.5:  # two surfaces, for example a side and a lid
            second = _shape(rng)[..., None]
            rgb = np.where(second > 0.5, texture(rng, TILE_PX), rgb)
    image = np.concatenate([rgb * alpha, alpha], axis=-1)
    return (image * 255 + 0.5).clip(0, 255).astype(np.uint8)


def recoloured(premultiplied: Array, alpha: Array, rng: np.random.Generator) -> Array:
    """The texture of a known object with its colour channels exchanged, inverted or both.

    If the object would still look like itself, it gets a random texture.
    """
    rgb = premultiplied / np.maximum(alpha, 1e-3)
    for _ in range(4):
        other = rgb[..., rng.permutation(3)]
        flip = rng.random(3) < 0.4
        other = np.where(flip, 1 - other, other)
        if (np.abs(other - rgb) * alpha).sum() / (3 * max(alpha.sum(), 1.0)) > OTHER_COLOUR:
            return other
    return texture(rng, rgb.shape[0])


def _shape(rng: np.random.Generator) -> Array:
    """A silhouette [T, T] in [0, 1]: a superellipse or a polygon with a few straight sides, half of them upright."""
    x, y = _plane(rng, TILE_PX, turned=rng.random() < 0.5)
    a, b = rng.uniform(0.25, 0.95, 2)
    if rng.random() < 0.5:
        inside = 1 - (np.abs(x / a) ** (p := rng.choice([2, 4, 8])) + np.abs(y / b) ** p) ** (1 / p)
    else:
        angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 8))))
        inside = np.min([rng.uniform(0.4, 0.9) - (x / a * np.cos(t) + y / b * np.sin(t)) for t in angles], axis=0)
        inside = np.minimum(inside, 1 - np.hypot(x, y))
    return (inside * min(a, b) * TILE_PX / 2 + 0.5).clip(0, 1)


def _plane(rng: np.random.Generator, side_px: int, *, turned: bool = True) -> tuple[Array, Array]:
    """Coordinates x and y [side_px, side_px] in [-1, 1], rotated by a random angle if `turned`."""
    axis = (np.arange(side_px) + 0.5) / side_px * 2 - 1
    x, y = np.meshgrid(axis, axis)
    angle = rng.uniform(0, 2 * np.pi) if turned else 0.0
    return x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)


def _enlarged(grid: Array, side_px: int, *, smooth: bool) -> Array:
    """Enlarges a grid of colours [n + 1, n + 1, 3] to [side_px, side_px, 3]: flat, or interpolated if `smooth`."""
    place = (np.arange(side_px) + 0.5) / side_px * (len(grid) - 1)
    low = place.astype(int)
    part = place - low if smooth else np.zeros(side_px)
    rows = grid[low] * (1 - part)[:, None, None] + grid[low + 1] * part[:, None, None]
    return rows[:, low] * (1 - part)[:, None] + rows[:, low + 1] * part[:, None]
