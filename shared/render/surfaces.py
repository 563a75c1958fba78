"""Surfaces made by code: wood, cloth, stone and tiles, as textures for tables and backgrounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIDE_PX = 512
Surface = NDArray[np.uint8]  # [512, 512, 3]


def _noise(rng: np.random.Generator, cells: tuple[int, int], octaves: int = 4) -> NDArray[np.float64]:
    """Smooth noise [512, 512], about -1 to 1, which repeats at its borders. `cells` is its coarsest grid."""
    result, weight = np.zeros((SIDE_PX, SIDE_PX)), 1.0
    for octave in range(octaves):
        rows, columns = (min(n << octave, SIDE_PX) for n in cells)
        grid = rng.uniform(-1, 1, (rows, columns))
        grid = np.concatenate([grid, grid[:1]])
        grid = np.concatenate([grid, grid[:, :1]], axis=1)
        y, x = np.arange(SIDE_PX) * rows / SIDE_PX, np.arange(SIDE_PX) * columns / SIDE_PX
        i, j = y.astype(int), x.astype(int)
        v, u = (t * t * (3 - 2 * t) for t in (y - i, x - j))
        top = grid[i][:, j] * (1 - u) + grid[i][:, j + 1] * u
        below = grid[i + 1][:, j] * (1 - u) + grid[i + 1][:, j + 1] * u
        result += weight * (top * (1 - v[:, None]) + below * v[:, None])
        weight /= 2
    return result / 1.5


def _coloured(share: NDArray[np.float64], dark: NDArray[np.float64], light: NDArray[np.float64]) -> Surface:
    share = np.clip(share, 0, 1)[..., None]
    return np.asarray(255 * (dark * (1 - share) + light * share), dtype=np.uint8)


def wood(rng: np.random.Generator) -> Surface:
    """Boards with a grain along x."""
    grain = _noise(rng, (24, 2), 3)
    rings = 0.5 + 0.5 * np.sin(18 * np.linspace(0, 1, SIDE_PX)[:, None] + 5 * grain)
    light = np.array([0.76, 0.57, 0.36]) * rng.uniform(0.6, 1.15)
    image = _coloured(0.25 + 0.6 * rings + 0.2 * _noise(rng, (64, 4), 2), light * 0.55, light)
    image[::SIDE_PX // 4] //= 2  # the joints of four boards
    return image


def cloth(rng: np.random.Generator) -> Surface:
    """A woven cloth in two colours, sometimes with stripes or checks."""
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX]
    weave = 0.15 * ((x // 2 + y // 2) % 2)
    wide = int(rng.choice([16, 32, 64]))
    pattern = {0: 0 * x, 1: x // wide % 2, 2: (x // wide + y // wide) % 2}[int(rng.integers(3))]
    dark, light = rng.uniform(0.1, 0.9, 3), rng.uniform(0.3, 1.0, 3)
    return _coloured(0.2 + 0.5 * pattern + weave + 0.15 * _noise(rng, (16, 16)), dark, light)


def stone(rng: np.random.Generator) -> Surface:
    """A speckled stone."""
    tone = rng.uniform(0.25, 0.8) * np.array([1.0, rng.uniform(0.92, 1.0), rng.uniform(0.85, 1.0)])
    veins = 1 - np.abs(_noise(rng, (4, 4), 5)) ** 0.5
    return _coloured(0.5 * veins + 0.5 + 0.4 * _noise(rng, (128, 128), 2), tone * 0.6, np.minimum(tone * 1.3, 1.0))


def tiles(rng: np.random.Generator) -> Surface:
    """Square tiles with joints."""
    side = SIDE_PX // int(rng.choice([2, 4]))
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX]
    joint = (x % side < 6) | (y % side < 6)
    tone = rng.uniform(0.4, 0.95) * rng.uniform(0.85, 1.0, 3)
    image = _coloured(0.6 + 0.25 * _noise(rng, (8, 8)), tone * 0.8, np.minimum(tone * 1.1, 1.0))
    image[joint] = image[joint] * 0.55
    return image


SURFACES = {"wood": wood, "cloth": cloth, "stone": stone, "tiles": tiles}


def surface(name: str) -> Surface:
    """The surface of that name, always the same. Raises KeyError if there is none."""
    return SURFACES[name](np.random.default_rng(sum(name.encode())))
