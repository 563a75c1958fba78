"""Rendered tables in any light, with exact labels: many objects that stand or lie, some hidden, seen from anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.shared.render.look import FLAT, random_look
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, direction, look_at, rotation_xyz

FRAME_PX = 256
MOST = 9  # objects on a table
LYING = 0.35  # share of the objects that do not stand as they should
PLAIN = 0.15  # share of the tables in the flat look
QUARTERS = np.pi / 2 * np.arange(4)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tables:
    """F images of tables [F, 256, 256, 3] with up to M objects on each.

    instance [F, 256, 256] says which of a table's objects a pixel shows, from 1 (0: none). For every object there are
    its number in `names` [F, M] (-1: none), its pose in the camera's frame [F, M, 4, 4], and how many of its pixels
    there would be if nothing hid it [F, M].
    """

    names: tuple[str, ...]
    rgb: NDArray[np.uint8]
    instance: NDArray[np.uint8]
    object: NDArray[np.int16]
    camera_from_object: NDArray[np.float32]
    whole_px: NDArray[np.int32]


def render_tables(meshes: tuple[Mesh, ...], count: int, rng: np.random.Generator, side_px: int = FRAME_PX) -> Tables:
    """Renders `count` tables with objects of `meshes`, in images of side_px x side_px. All randomness comes from
    `rng`."""
    intrinsics = np.array(INTRINSICS_PX) * side_px / IMAGE_SIZE_PX
    world, names = World(meshes, size_px=side_px, intrinsics_px=intrinsics), tuple(mesh.name for mesh in meshes)
    shape = (count, side_px, side_px)
    tables = Tables(names, np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8),
                    np.full((count, MOST), -1, np.int16), np.zeros((count, MOST, 4, 4), np.float32),
                    np.zeros((count, MOST), np.int32))
    for n in range(count):
        _render(world, tables, n, rng)
    world.close()
    return tables


def _render(world: World, tables: Tables, n: int, rng: np.random.Generator) -> None:
    chosen = rng.permutation(len(tables.names))[:1 + min(int(rng.geometric(0.25)) - 1, MOST - 1)]
    poses = _placed([world.meshes[tables.names[k]] for k in chosen], rng)
    camera = _camera(poses, rng)
    look = FLAT if rng.random() < PLAIN else random_look(rng)
    world.set_look(look)
    named = {tables.names[k]: pose for k, pose in zip(chosen, poses, strict=True)}
    table_rgb = rng.random(3) * 255
    world.place(named, table_rgb)
    tables.rgb[n] = look.seen(world.render(camera), rng)
    seen = world.render_masks(camera)
    inverse = np.linalg.inv(camera)
    for slot, k in enumerate(chosen):
        name = tables.names[k]
        tables.instance[n][seen[name]] = slot + 1
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = named[name]
        tables.object[n, slot], tables.camera_from_object[n, slot] = k, inverse @ pose
        hidden = len(chosen) > 1 and seen[name].any()
        if hidden:
            world.place({name: named[name]}, table_rgb)
        tables.whole_px[n, slot] = (world.render_masks(camera)[name] if hidden else seen[name]).sum()


def _placed(meshes: list[Mesh], rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Centres [3] and rotations [3, 3] of objects that stand or lie on the table and hardly overlap."""
    placed: list[tuple[Array, Array, float]] = []
    spread = rng.uniform(0.08, 0.35)
    for mesh in meshes:
        turn = rotation_xyz((0.0, 0.0, rng.uniform(0, 2 * np.pi)))
        if rng.random() < LYING:
            turn = turn @ rotation_xyz((rng.choice(QUARTERS), rng.choice(QUARTERS), 0.0))
        points = mesh.vertices_m.astype(np.float64) @ turn.T
        radius = float(np.linalg.norm(np.ptp(points[:, :2], axis=0))) / 2
        for _ in range(20):
            xy = rng.uniform(-spread, spread, 2)
            if all(np.linalg.norm(xy - other[:2]) > 0.8 * (radius + r) for other, _, r in placed):
                break
            spread *= 1.05
        placed.append((np.array([*xy, -points[:, 2].min()]), turn, radius))
    return [(center, turn) for center, turn, _ in placed]


def _camera(poses: list[tuple[Array, Array]], rng: np.random.Generator) -> Array:
    """A camera that looks at one of the objects or near it, from 0.2 to 1.4 m, a little rolled."""
    target = poses[int(rng.integers(len(poses)))][0] + rng.normal(0, 0.05, 3)
    elevation = np.arcsin(rng.uniform(0.08, 0.99))
    range_m = 0.2 * 7.0 ** rng.random()
    camera = look_at(target + range_m * direction(rng.uniform(0, 2 * np.pi), elevation), target)
    camera[2, 3] = max(camera[2, 3], 0.06)
    camera[:3, :3] = camera[:3, :3] @ rotation_xyz((0.0, 0.0, rng.normal(0, 0.15)))
    return camera
