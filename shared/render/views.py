"""Views of single objects for training: square tiles on black, with coverage, from several ranges ("shells")."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import REFERENCE_RANGE_M, direction, fibonacci_hemisphere, look_at

RENDER_PX, TILE_PX = 256, 128


@dataclass(frozen=True)
class ObjectViews:
    """Tiles [S, N, T, T, 4] uint8 of one object, from S ranges ("shells") and N directions.

    A tile holds RGB, premultiplied by the coverage, and the coverage. azimuth_rad [N] and elevation_rad [N] are the
    directions. A tile is crop_side_m wide at the object's centre. size_m [3] are the extents of the object's box.
    """

    name: str
    tiles: NDArray[np.uint8]
    shells_m: tuple[float, ...]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    crop_side_m: float
    size_m: NDArray[np.float64]


def crop_side_m(size_m: NDArray[np.float64]) -> float:
    """Side (m) of the square around an object that its crop covers: the box's diagonal and a margin for perspective."""
    return float(1.1 * np.linalg.norm(size_m))


def default_shells_m(size_m: NDArray[np.float64]) -> tuple[float, ...]:
    """Ranges (m) of the views: the nearest that is allowed, the paper's 0.40 m, and two that teach perspective."""
    return (float(np.linalg.norm(size_m)) / 2 + 0.08, 0.28, REFERENCE_RANGE_M, 0.75)


def render_views(mesh: Mesh, *, count: int = 500, shells_m: tuple[float, ...] | None = None,
                 progress: Callable[[int], None] = lambda done: None) -> ObjectViews:
    """Renders `count` views on a Fibonacci hemisphere (paper, appendix B) from each range.

    The camera looks at the object's centre, and its field of view is that of the crop. `progress` is called with the
    number of views that are done.
    """
    shells_m = shells_m or default_shells_m(mesh.size_m)
    side = crop_side_m(mesh.size_m)
    azimuth, elevation = fibonacci_hemisphere(count)
    offsets = direction(azimuth, elevation)
    world = World((mesh,), size_px=RENDER_PX)
    world.show_table(False)
    tiles = np.empty((len(shells_m), count, TILE_PX, TILE_PX, 4), dtype=np.uint8)
    for s, shell in enumerate(shells_m):
        focal = RENDER_PX * shell / side
        world.set_intrinsics((focal, focal, RENDER_PX / 2, RENDER_PX / 2))
        world.place({mesh.name: (np.zeros(3), 0.0)})
        for i in range(count):
            camera = look_at(shell * offsets[i], np.zeros(3))
            image = np.dstack([world.render(camera), np.uint8(255) * world.render_masks(camera)[mesh.name]])
            tiles[s, i] = _halve(image)
            progress(s * count + i + 1)
    world.close()
    return ObjectViews(mesh.name, tiles, tuple(shells_m), azimuth, elevation, side, mesh.size_m)


def _halve(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = image.shape[0] // 2
    blocks = image.reshape(size, 2, size, 2, -1).astype(np.uint16).sum(axis=(1, 3))
    return ((blocks + 2) // 4).astype(np.uint8)
