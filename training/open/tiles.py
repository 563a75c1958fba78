"""Views of many objects from all around, flat and under lights, to train networks that know no object by name."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.files import writing
from saccade.shared.render.look import FLAT, Light, Look
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.views import crop_side_m
from saccade.shared.render.world import World
from saccade.shared.world.geometry import circle_around, fibonacci_sphere, look_at

TILE_PX, FINER = 80, 2  # side of a tile; it is rendered finer and averaged
RANGES = (2.5, 5.0)  # of the camera, in units of the half diagonal of the object's box
TOGETHER = 32  # meshes in one model


@dataclass(frozen=True)
class Tiles:
    """Views of one object: images [N, V, 80, 80, 4] uint8 (RGB, premultiplied by the coverage, and the coverage).

    The first of the V variants is flat, the others are lit. directions [N, 3] point from the object to the camera, in
    the object's frame. A tile covers the side of the object's crop (`crop_side_m`) at its centre. `circles` [N, 3] are
    the smallest circles around the object's outline: centre (right, down) and radius, in half sides of the tile.
    """

    name: str
    images: NDArray[np.uint8]
    directions: NDArray[np.float64]
    circles: NDArray[np.float64]


def random_light(rng: np.random.Generator) -> Look:
    """Light of any kind on an object alone."""
    lights = []
    for _ in range(int(rng.integers(1, 4))):
        direction = rng.normal(size=3)
        direction[2] = -abs(direction[2]) - 0.1
        lights.append(Light(direction=tuple(direction), diffuse=rng.uniform(0.1, 0.8), specular=rng.uniform(0, 0.5),
                            shadow=False))
    strength = sum(light.diffuse for light in lights)
    return Look(ambient=max(0.2, rng.uniform(0.4, 0.9) - 0.35 * strength), headlight=rng.uniform(0, 0.3),
                lights=tuple(lights), object_specular=rng.uniform(0, 0.6) if rng.random() < 0.5 else 0.0)


def render_tiles(folder: Path, meshes: Sequence[Mesh], *, count: int, variants: int, seed: int,
                 progress: Callable[[str], None] = lambda name: None) -> None:
    """Renders the tiles that `folder` lacks: `count` directions of each object in `variants` variants each.

    `progress` is called with the name of each object that is done. Raises SaccadeError if they cannot be written.
    """
    missing = [mesh for mesh in meshes if not _path(folder, mesh.name).is_file()]
    with writing(folder, "views"):
        folder.mkdir(parents=True, exist_ok=True)
    for start in range(0, len(missing), TOGETHER):
        some = missing[start:start + TOGETHER]
        world = World(tuple(some), size_px=TILE_PX * FINER)
        world.show_table(False)
        for mesh in some:
            images = _render(world, mesh, count, variants, np.random.default_rng([seed, *mesh.name.encode()]))
            path = _path(folder, mesh.name)
            with writing(path, "views"):
                np.save(_circles_path(folder, mesh.name), circles_of(images[:, 0, ..., 3]))
                temporary = path.with_suffix(".tmp.npy")  # last and at once, because it says that both are there
                np.save(temporary, images)
                os.replace(temporary, path)
            progress(mesh.name)
        world.close()


def tiles_of(mesh: Mesh, count: int) -> Tiles:
    """Flat views of one object from `count` directions. Raises SaccadeError if OpenGL does not work."""
    world = World((mesh,), size_px=TILE_PX * FINER)
    world.show_table(False)
    images = _render(world, mesh, count, 1, np.random.default_rng(0))
    world.close()
    return Tiles(mesh.name, images, fibonacci_sphere(count), circles_of(images[:, 0, ..., 3]))


def _render(world: World, mesh: Mesh, count: int, variants: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    side, half = crop_side_m(mesh.size_m), float(np.linalg.norm(mesh.size_m)) / 2
    images = np.empty((count, variants, TILE_PX, TILE_PX, 4), dtype=np.uint8)
    size = TILE_PX * FINER
    for n, direction in enumerate(fibonacci_sphere(count)):
        range_m = half * rng.uniform(*RANGES)
        focal = size * range_m / side
        world.set_intrinsics((focal, focal, size / 2, size / 2))
        camera = look_at(range_m * direction, np.zeros(3))
        for variant in range(variants):
            world.set_look(random_light(rng) if variant else FLAT)
            world.place({mesh.name: (np.zeros(3), 0.0)})
            images[n, variant, ..., :3] = _finer(world.render(camera))
            if variant == 0:
                images[n, :, ..., 3] = _finer(np.uint8(255) * world.render_masks(camera)[mesh.name][..., None])[..., 0]
    return images


def _finer(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image [S, S, C] averaged to [80, 80, C]."""
    blocks = image.reshape(TILE_PX, FINER, TILE_PX, FINER, -1).astype(np.uint16).sum(axis=(1, 3))
    return ((blocks + FINER ** 2 // 2) // FINER ** 2).astype(np.uint8)


def circles_of(coverage: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The circles [N, 3] around outlines with this coverage [N, S, S], see `Tiles`. An empty one has the whole tile."""
    size, circles = coverage.shape[-1], []
    for shown in coverage > 127:
        rows = np.flatnonzero(shown.any(1))
        if not len(rows):
            circles.append((0.0, 0.0, 1.0))
            continue
        first, last = shown.argmax(1)[rows], size - shown[:, ::-1].argmax(1)[rows]  # the ends of each row
        corners = [np.stack([x, y], 1) for x in (first, last) for y in (rows, rows + 1)]
        center, radius = circle_around(2 * np.concatenate(corners) / size - 1)
        circles.append((*center, radius))
    return np.array(circles)


def load_tiles(folder: Path, names: Sequence[str]) -> Iterator[Tiles]:
    """Opens the tiles of these objects; they are read where they are used. Raises SaccadeError if one is missing or
    damaged."""
    for name in names:
        path = _path(folder, name)
        try:
            images = np.load(path, mmap_mode="r", allow_pickle=False)
            circles = np.load(_circles_path(folder, name), allow_pickle=False)
            if images.ndim != 5 or images.shape[2:] != (TILE_PX, TILE_PX, 4) or images.dtype != np.uint8 \
                    or circles.shape != (len(images), 3):
                raise ValueError(f"shapes {images.shape} and {circles.shape}")
        except (OSError, ValueError) as error:
            raise SaccadeError(f"views {path} are missing or damaged ({error}): remove the file, they are rendered "
                               "again") from error
        yield Tiles(name, images, fibonacci_sphere(len(images)), circles)


def _path(folder: Path, name: str) -> Path:
    return folder / f"{name}.npy"


def _circles_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.circles.npy"
