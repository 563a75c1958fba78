"""Draws the poses of a file, from above and from the side: each camera as a frustum, with the table's plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from saccade.app.look.picture import new_figure, save
from saccade.services.camera.trajectories.trajectory import NAMES, Trajectory
from saccade.shared.errors import printable
from saccade.shared.world.geometry import Array

INCHES, DPI = (13.0, 6.8), 100
MAX_DRAWN = 40  # cameras; more would cover one another
TABLE_HALF_M = 0.5
SHARE = 0.09  # of the picture's side, which a frustum is deep
FRUSTUM = np.array([[0.0, 0.0, 0.0], [-0.55, 0.42, -1], [0.55, 0.42, -1], [0.55, -0.42, -1], [-0.55, -0.42, -1]])
SIDES = ((0, 1), (0, 2), (0, 3), (0, 4), (2, 3), (3, 4), (4, 1))  # lines between corners; the top edge is drawn in red
PATH, CAMERA, TOP, LOOK, TABLE, FIRST = "#9aa5ad", "#2e4057", "#d1495b", "#00798c", "#c9b79c", "#3a7d44"


def draw_poses(read: Trajectory, out: Path) -> None:
    """Draws a trajectory as a picture. The same poses give the same bytes. Raises SaccadeError if the file cannot be
    written."""
    figure = new_figure(INCHES, DPI)
    above, side = figure.subplots(1, 2)
    size_m = _size_m(read.world_from_camera[:, :3, 3])
    _draw(above, read.world_from_camera, (0, 1), size_m)
    _draw(side, read.world_from_camera, (0, 2), size_m)
    above.set(title="from above", xlabel="x (m)", ylabel="y (m)")
    side.set(title="from the side", xlabel="x (m)", ylabel="z (m), up")
    above.plot(*_square(), color=TABLE, lw=2)
    side.axhline(0, color=TABLE, lw=1, ls=":")
    side.plot([-TABLE_HALF_M, TABLE_HALF_M], [0, 0], color=TABLE, lw=4, label="table's top, z = 0")
    figure.legend(*side.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    name = printable(read.path.name, 80).replace("$", r"\$")
    figure.suptitle(f"{name}: {len(read.keys)} poses, {NAMES[read.format]}")
    save(figure, out)


def _size_m(positions: Array) -> float:
    """The side of a square that shows cameras and table, in metres."""
    both = np.vstack([positions, [[-TABLE_HALF_M] * 3, [TABLE_HALF_M] * 3]])
    return float((both.max(0) - both.min(0)).max())


def _square() -> tuple[list[float], list[float]]:
    a = TABLE_HALF_M
    return [-a, a, a, -a, -a], [-a, -a, a, a, -a]


def _draw(axes: Axes, poses: Array, shown: tuple[int, int], size_m: float) -> None:
    """Draws poses [N, 4, 4] in the plane of two axes of the world."""
    positions = poses[:, :3, 3][:, shown]
    axes.plot(*positions.T, color=PATH, lw=1, zorder=1)
    axes.plot(*positions[0], "o", color=FIRST, ms=7, zorder=4, label="first pose")
    depth_m = SHARE * size_m
    drawn = poses[np.unique(np.linspace(0, len(poses) - 1, min(MAX_DRAWN, len(poses))).round().astype(int))]
    corners = drawn[:, None, :3, 3] + np.einsum("nij,kj->nki", drawn[:, :3, :3], depth_m * FRUSTUM)
    corners = corners[..., shown]
    sides = [corner[list(pair)] for corner in corners for pair in SIDES]
    axes.add_collection(LineCollection(sides, colors=CAMERA, linewidths=0.8, zorder=2))
    tops = [corner[[1, 2]] for corner in corners]
    axes.add_collection(LineCollection(tops, colors=TOP, linewidths=2, zorder=3, label="top edge of the image"))
    looks = [[c, c + (f - c) * 2.2] for c, f in zip(drawn[:, :3, 3][:, shown], corners[:, 1:].mean(1), strict=True)]
    axes.add_collection(LineCollection(looks, colors=LOOK, linewidths=1, zorder=2, label="looking direction"))
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.grid(alpha=0.25)
