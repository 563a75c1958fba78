"""Gives a surface the colours of the pictures: each face is drawn as the picture shows it that sees it best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from saccade.app.objects.views.hull import Hull
from saccade.app.objects.views.view import View
from saccade.shared.render.mesh_parts import GREY, Part, coloured
from saccade.shared.world.geometry import Array, project, unit

MOST_VIEWS = 32  # that give colours: fewer seams
ALONG = 0.2  # cosine of the angle between a face and the view from which on it is seen well enough
CELL_PX = 4.0  # of the map of depths, at the object's resolution
BEHIND = 0.02  # of the object's size, which is how far a face may lie behind the nearest one
WITHIN_PX = 1.5  # of the outline a pixel may be the background's
ROUNDS, TOGETHER = 4, 0.15  # how neighbours are brought to one picture, and what a neighbour's picture is worth
NEAREST = 100  # faces that are seen whose colour a hidden face has
MARGIN_PX = 4


def coloured_parts(hull: Hull) -> tuple[list[Part], float]:
    """The parts of a surface, one for each picture that colours some of it, and the share of its area that is seen."""
    corners = hull.points_m[hull.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals, areas = unit(across), np.linalg.norm(across, axis=1)
    worth = np.stack([_worth(view, corners, normals) for view in hull.views], axis=1)
    worth[:, ~_chosen(worth)] = 0.0
    seen = worth.max(1) > 0
    picked = _together(worth, hull.faces)
    parts = []
    for number in np.unique(picked[seen]):
        parts.append(_part(hull.views[number], corners[seen & (picked == number)]))
    if not seen.all():
        parts.append(_hidden(parts, corners[~seen]))
    return parts, float(areas[seen].sum() / areas.sum())


def _worth(view: View, corners: Array, normals: Array) -> NDArray[np.float32]:
    """How well a view shows faces [F, 3, 3] with these normals [F, 3]: the number of pixels for a square metre, in the
    square root, and 0 if it does not show them [F]."""
    middles = corners.mean(1)
    facing = (normals * unit(view.position_m - middles)).sum(1)
    pixels, depth = project(corners, view.world_from_camera, view.intrinsics_px)
    size = np.ptp(corners.reshape(-1, 3), axis=0).max()
    shape = np.array(view.mask.shape)
    cells = np.clip((pixels / CELL_PX).astype(int), 0, (shape[::-1] / CELL_PX).astype(int))
    nearest = np.full((shape / CELL_PX).astype(int) + 1, np.inf)
    np.minimum.at(nearest, (cells[..., 1], cells[..., 0]), depth)
    own = (pixels.mean(1) / CELL_PX).astype(int)
    own = np.clip(own, 0, np.array(nearest.shape)[::-1] - 1)
    in_front = depth.mean(1) <= nearest[own[:, 1], own[:, 0]] + BEHIND * size + CELL_PX * depth.mean(1) \
        / view.intrinsics_px[0] * np.sqrt(1 / np.maximum(facing, ALONG) ** 2 - 1)
    within = distance_transform_edt(view.mask)
    whole = ((pixels >= 0) & (pixels < shape[::-1])).all((1, 2))
    at = np.clip(pixels.astype(int), 0, shape[::-1] - 1)
    safe = (within[at[..., 1], at[..., 0]] > WITHIN_PX).all(1)
    worth = facing * view.intrinsics_px[0] / np.maximum(depth.mean(1), 1e-9)
    return np.where((facing > ALONG) & in_front & whole & safe, worth, 0.0).astype(np.float32)


def _chosen(worth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """At most MOST_VIEWS views [V] that show the faces best together, found one after the other."""
    best, chosen = np.zeros(len(worth), dtype=np.float32), np.zeros(worth.shape[1], dtype=bool)
    for _ in range(min(MOST_VIEWS, worth.shape[1])):
        gains = np.maximum(worth - best[:, None], 0.0).sum(0)
        number = int(gains.argmax())
        if gains[number] <= 0:
            break
        chosen[number] = True
        best = np.maximum(best, worth[:, number])
    return chosen


def _together(worth: NDArray[np.float32], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The number of the view for each face [F]. Faces that share a corner prefer the same one."""
    scaled = worth / max(float(worth.max()), 1e-9)
    picked = scaled.argmax(1)
    corners = int(faces.max()) + 1
    for _ in range(ROUNDS):
        votes = np.zeros((corners, worth.shape[1]), dtype=np.float32)
        for column in range(3):
            np.add.at(votes, (faces[:, column], picked), 1.0)
        shares = votes / np.maximum(votes.sum(1, keepdims=True), 1.0)
        preferred = scaled + TOGETHER * shares[faces].sum(1)
        picked = np.where(scaled > 0, preferred, -1.0).argmax(1)
    return picked


def _part(view: View, corners: Array) -> Part:
    """Faces [F, 3, 3] with the part of a picture that shows them."""
    pixels, _ = project(corners, view.world_from_camera, view.intrinsics_px)
    height, width = view.mask.shape
    low = np.maximum(np.floor(pixels.min((0, 1))).astype(int) - MARGIN_PX, 0)
    high = np.minimum(np.ceil(pixels.max((0, 1))).astype(int) + MARGIN_PX, (width, height))
    size = high - low
    uv = (pixels - low) / size
    uv[..., 1] = 1.0 - uv[..., 1]
    return Part(corners, np.clip(uv, 0.0, 1.0), Image.fromarray(view.rgb[low[1]:high[1], low[0]:high[0]]))


def _hidden(parts: list[Part], corners: Array) -> Part:
    """Faces [F, 3, 3] that no picture shows, in the colours of those nearest to them."""
    places, colours = [], []
    for part in parts:
        if part.uv is None or part.image is None:  # not one that `_part` makes
            continue
        image = np.asarray(part.image)
        at = part.uv.mean(1) * (1, -1) + (0, 1)
        columns, rows = np.clip((at * image.shape[1::-1]).astype(int), 0, np.array(image.shape[1::-1]) - 1).T
        places.append(part.corners.mean(1))
        colours.append(image[rows, columns])
    if not places:
        return coloured(corners, GREY)
    tree = cKDTree(np.concatenate(places))
    count = min(NEAREST, tree.n)
    _, near = tree.query(corners.mean(1), k=count)
    means = np.concatenate(colours)[near.reshape(-1, count)].mean(1)
    return coloured(corners, means.round()[:, None])
