"""Guidance for a hand that holds the camera: where to go from here to come to a viewpoint, as an arrow, a ghost of the
view, two numbers and words.

These are functions of poses, without images. Directions are given as the person who holds the camera sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from saccade.shared.world.geometry import Array, look_at, pixel_rays, project, rotation_vector, unit

State = Literal["move", "hold", "there"]

TURN_M = 0.10  # nearer than this to the viewpoint the camera turns as planned; before, it looks at what is to be seen
NEAR_M, NEAR_RAD = 0.035, 0.17  # a hand that is so near to the viewpoint holds still
DETOUR_RAD = 0.5  # a move that differs by more than this from the straight way leads around something
SAID_M, SAID_RAD, SAID_SHARE = 0.02, np.radians(5), 0.25  # smaller parts of a move or a turn are not put into words
ARROW_AT, ARROW_M, ARROW_WIDE_M = np.array([0.0, -0.07, -0.35]), (0.03, 0.12), 0.022  # the arrow in front of the camera
INSET = 0.1  # share of the image by which the frame of the ghost is inside its border
CORNERS = 24  # of the circle at the top and at the bottom of an object's outline
BEHIND_M = 0.02  # what is not farther in front of the camera than this is not drawn


@dataclass(frozen=True)
class Guidance:
    """What a person is told.

    `state`: `move`, `hold` (near enough: stay until the agent has looked), or `there` (the goal's view is reached).
    `distance_m` and `turn_rad` are what is left. `move_m` [3] are the parts of the move, level with the table: to the
    right, up, forward. `turns_rad` [3] are those of the turn: to the left, up, and counter-clockwise as seen from
    behind the camera. `words` say the same. `arrow_px` [7, 2] is the outline of an arrow in the image, and `frame_px`
    [4, 2] that of the wanted view's image, seen from here; either has no points where it is not in front of the camera.
    """

    state: State
    distance_m: float
    turn_rad: float
    move_m: Array
    turns_rad: Array
    words: str
    arrow_px: Array
    frame_px: Array


def guide(world_from_camera: ArrayLike, viewpoint: ArrayLike, look_at_m: ArrayLike, intrinsics_px: ArrayLike,
          size_px: tuple[int, int], *, step_m: ArrayLike | None = None, there: bool = False) -> Guidance:
    """The guidance from a camera pose [4, 4] to a viewpoint [4, 4], which looks at the point `look_at_m` [3].

    `intrinsics_px` are those of the image, whose width and height are `size_px`. `step_m` [3] is the next move that the
    agent proposes, in the world's axes: where it leads around something, the arrow follows it. `there` says that the
    agent has arrived.
    """
    camera, wanted = np.asarray(world_from_camera, dtype=np.float64), np.asarray(viewpoint, dtype=np.float64)
    straight = wanted[:3, 3] - camera[:3, 3]
    distance_m = float(np.linalg.norm(straight))
    move = distance_m * _way(straight, step_m)
    turn = rotation_vector(camera[:3, :3].T @ attitude(camera, wanted, look_at_m)[:3, :3])
    turn_rad = float(np.linalg.norm(turn))
    near = distance_m < NEAR_M and turn_rad < NEAR_RAD
    state: State = "there" if there else "hold" if near else "move"
    move_m, turns_rad = level_axes(camera).T @ move, turn[[1, 0, 2]]
    arrow_px = arrow(camera[:3, :3].T @ move, intrinsics_px) if state == "move" and distance_m >= SAID_M \
        else np.zeros((0, 2))
    return Guidance(state, distance_m, turn_rad, move_m, turns_rad, words(state, move_m, turns_rad), arrow_px,
                    frame(camera, wanted, look_at_m, intrinsics_px, size_px))


def attitude(world_from_camera: ArrayLike, viewpoint: ArrayLike, look_at_m: ArrayLike) -> Array:
    """The pose [4, 4] to turn to at the camera's present position: on the way the camera looks at what is to be seen,
    and near the viewpoint it takes the planned attitude."""
    camera, wanted = np.asarray(world_from_camera), np.asarray(viewpoint)
    if np.linalg.norm(wanted[:3, 3] - camera[:3, 3]) > TURN_M:
        return look_at(camera[:3, 3], look_at_m)
    turned = np.array(camera, dtype=np.float64)
    turned[:3, :3] = wanted[:3, :3]
    return turned


def _way(straight: Array, step_m: ArrayLike | None) -> Array:
    """The unit vector [3] to go along: straight, or where the agent goes around something."""
    if step_m is None or np.linalg.norm(straight) < TURN_M or np.linalg.norm(step_m) < 1e-6:
        return unit(straight)
    around = unit(step_m)
    return around if float(around @ unit(straight)) < np.cos(DETOUR_RAD) else unit(straight)


def level_axes(world_from_camera: ArrayLike) -> Array:
    """The axes [3, 3] of a person who holds the camera and stands upright: the columns are right, up and forward.

    Forward is where the camera looks or, if it looks down, where the top of its image points.
    """
    camera = np.asarray(world_from_camera, dtype=np.float64)
    ahead = (camera[:3, 1] - camera[:3, 2]) * (1.0, 1.0, 0.0)
    forward = unit(ahead) if np.linalg.norm(ahead) > 1e-6 else np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(forward, up), up, forward], axis=-1)


def words(state: State, move_m: ArrayLike, turns_rad: ArrayLike) -> str:
    """The guidance in plain English, from the parts of the move [3] and of the turn [3] as in `Guidance`."""
    if state == "there":
        return "you are there"
    moves = _parts(move_m, SAID_M, (("to the right", "to the left"), ("up", "down"), ("forward", "back")))
    turns = _parts(turns_rad, SAID_RAD, (("to the left", "to the right"), ("up", "down"),
                                         ("counter-clockwise", "clockwise")))
    said = []
    if moves:
        said.append("move " + _listed([f"{100 * size:.0f} cm {where}" for _, size, where in moves]))
    for verb, (axis, size, where) in zip(_VERBS, _by_axis(turns), strict=True):
        if axis is not None:
            said.append(f"{verb} {np.degrees(size):.0f} degrees {where}")
    if state == "hold" or not said:
        return "hold still"
    return ", ".join(said)


_VERBS = ("turn", "tilt", "roll")


def _parts(values: ArrayLike, least: float, names: Sequence[tuple[str, str]]) -> list[tuple[int, float, str]]:
    """The parts that are worth saying: their axis, size and direction."""
    numbers = np.asarray(values, dtype=np.float64)
    least = max(least, SAID_SHARE * float(np.abs(numbers).max()))
    return [(axis, abs(number), names[axis][int(number < 0)]) for axis, number in enumerate(numbers)
            if abs(number) >= least]


def _by_axis(parts: list[tuple[int, float, str]]) -> list[tuple[int | None, float, str]]:
    there = {axis: (axis, size, where) for axis, size, where in parts}
    return [there.get(axis, (None, 0.0, "")) for axis in range(3)]


def _listed(texts: list[str]) -> str:
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def arrow(move: ArrayLike, intrinsics_px: ArrayLike) -> Array:
    """The outline [7, 2] (pixels) of a flat arrow in front of the camera that points along `move` [3], which is in the
    camera's frame (metres). It is drawn in perspective, so that forward and back can be told. It has no points if there
    is no move."""
    move = np.asarray(move, dtype=np.float64)
    length = float(np.linalg.norm(move))
    if length < 1e-9:
        return np.zeros((0, 2))
    along = move / length
    side = np.cross(along, unit(ARROW_AT))
    side = unit(side) if np.linalg.norm(side) > 1e-6 else np.array([1.0, 0.0, 0.0])
    reach = along * np.clip(length, *ARROW_M)
    neck, wide = ARROW_AT + 0.6 * reach, ARROW_WIDE_M * side
    points = np.stack([ARROW_AT + wide / 2, neck + wide / 2, neck + wide, ARROW_AT + reach, neck - wide,
                       neck - wide / 2, ARROW_AT - wide / 2])
    return project(points, np.eye(4), intrinsics_px)[0]


def frame(world_from_camera: ArrayLike, viewpoint: ArrayLike, look_at_m: ArrayLike, intrinsics_px: ArrayLike,
          size_px: tuple[int, int]) -> Array:
    """The frame of the image that the viewpoint sees, as it is seen from the camera: corners [4, 2] in pixels, from the
    top left one clockwise.

    It lies a little inside the border, at the distance of what is looked at, so at the viewpoint it fits the image. It
    has no points if a part of it is not in front of the camera.
    """
    wanted = np.asarray(viewpoint, dtype=np.float64)
    width, height = size_px
    left, top = INSET * width, INSET * height
    corners = np.array([(left, top), (width - left, top), (width - left, height - top), (left, height - top)])
    rays = pixel_rays(corners, intrinsics_px)
    depth = max(float(-wanted[:3, 2] @ (np.asarray(look_at_m) - wanted[:3, 3])), 0.1)
    points = wanted[:3, 3] + (rays / -rays[:, 2:] * depth) @ wanted[:3, :3].T
    return _drawn(points, world_from_camera, intrinsics_px)


def outline(viewpoint: ArrayLike, center_m: ArrayLike, size_m: ArrayLike, intrinsics_px: ArrayLike) -> Array:
    """Where an object should be in the image at the viewpoint [4, 4]: the outline [N, 2] (pixels) of an upright
    cylinder around `center_m` [3] that is as high and, on average, as wide as the object's box `size_m` [3]. It has no
    points if a part of it is not in front of the camera."""
    x, y, z = np.asarray(size_m, dtype=np.float64)
    around = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    circle = (x + y) / 4 * np.stack([np.cos(around), np.sin(around), np.zeros(CORNERS)], axis=-1)
    half = np.array([0.0, 0.0, z / 2])
    points = np.asarray(center_m) + np.concatenate([circle + half, circle - half])
    return hull(_drawn(points, viewpoint, intrinsics_px))


def _drawn(points: Array, world_from_camera: ArrayLike, intrinsics_px: ArrayLike) -> Array:
    pixels, depth = project(points, world_from_camera, intrinsics_px)
    return pixels if depth.min() > BEHIND_M else np.zeros((0, 2))


def hull(points: ArrayLike) -> Array:
    """The convex hull [M, 2] of points [N, 2], in order (Andrew's monotone chain, 1979)."""
    ordered = sorted(map(tuple, np.asarray(points, dtype=np.float64)))

    def half(given: list[tuple]) -> list[tuple]:
        kept: list[tuple] = []
        for x, y in given:
            while len(kept) > 1 and ((kept[-1][0] - kept[-2][0]) * (y - kept[-2][1])
                                     <= (kept[-1][1] - kept[-2][1]) * (x - kept[-2][0])):
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(half(ordered) + half(ordered[::-1]) or ordered).reshape(-1, 2)
