"""Images of a printed board as a lens would show it: every pixel's ray is followed to the sheet, without a renderer."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np

from saccade.services.camera.charuco import Board, grey_of
from saccade.services.camera.trajectories.lens import lens
from saccade.shared.world.geometry import direction, look_at, pose

SHEET = Board(squares=(7, 10), square_m=0.025, marker_m=0.019)
SECOND = SHEET.model_copy(update={"first_marker": 35})
SIZE = (640, 480)
FOCAL = {"fx": 610.0, "fy": 612.0, "cx": 325.0, "cy": 236.0}
PINHOLE = lens(FOCAL | {"k1": -0.21, "k2": 0.07, "p1": 0.001, "p2": -0.0012, "k3": -0.01}, SIZE)
FISHEYE = lens({"fx": 330.0, "fy": 331.0, "cx": 318.0, "cy": 242.0, "k1": 0.03, "k2": -0.012, "k3": 0.003,
                "k4": -0.001}, SIZE, fisheye=True)
TEXELS_PER_M = 6000  # 19 for each cell of a marker of SHEET
SAMPLES = 2  # on each side of a pixel
MARGIN_M = 0.01


@cache
def printed(board: Board = SHEET) -> np.ndarray:
    """The sheet as grey values [H, W] from 0 to 1, with a white margin."""
    return grey_of(board, texels_per_m=TEXELS_PER_M, margin_m=MARGIN_M).astype(np.float32) / 255


def seen(world_from_camera, camera=PINHOLE, board: Board = SHEET, sheet: np.ndarray | None = None) -> np.ndarray:
    """The image [H, W, 3] of the board on a grey table."""
    import cv2

    sheet = printed(board) if sheet is None else sheet
    (width, height), rays = camera.size_px, _rays(camera)
    turn, eye = world_from_camera[:3, :3].astype(np.float32), world_from_camera[:3, 3].astype(np.float32)
    towards = np.stack([rays[:, 0], -rays[:, 1], -np.ones(len(rays), np.float32)], axis=1) @ turn.T
    far = np.where(towards[:, 2] < 0, eye[2] / -towards[:, 2], np.float32(np.nan))
    x, y = (eye[:2] + far[:, None] * towards[:, :2]).T
    half = board.size_m / 2 + MARGIN_M
    places = np.stack([x + half[0], half[1] - y], axis=1) * TEXELS_PER_M - 0.5
    places = np.nan_to_num(places, nan=-1e4).astype(np.float32).reshape(height * SAMPLES, width * SAMPLES, 2)
    fine = cv2.remap(sheet, places, None, cv2.INTER_LINEAR, borderValue=0.55)
    grey = 30 + 200 * fine.reshape(height, SAMPLES, width, SAMPLES).mean((1, 3))
    return np.repeat(grey.round().astype(np.uint8)[..., None], 3, axis=2)


def both_on_the_table(world_from_camera) -> np.ndarray:
    """The image [H, W, 3] of SHEET at the origin and of SECOND, turned by 90 degrees, at (0.30, -0.02)."""
    sheets, width = [printed(SHEET), np.rot90(printed(SECOND))], 0.56
    canvas = np.full((round(0.30 * TEXELS_PER_M), round(width * TEXELS_PER_M)), 0.55, np.float32)
    for sheet, (x, y) in zip(sheets, ((0.12, 0.15), (0.42, 0.13)), strict=True):
        top, left = (round(TEXELS_PER_M * at) - side // 2 for at, side in zip((y, x), sheet.shape, strict=True))
        canvas[top:top + sheet.shape[0], left:left + sheet.shape[1]] = sheet
    whole = SimpleNamespace(size_m=np.array([width, 0.30]) - 2 * MARGIN_M)
    moved = pose(world_from_camera[:3, :3], world_from_camera[:3, 3] - (width / 2 - 0.12, 0.0, 0.0))
    return seen(moved, board=whole, sheet=canvas)


@cache
def _rays(camera) -> np.ndarray:
    """The rays [N, 2] of all samples of an image."""
    u, v = ((np.arange(count * SAMPLES) + 0.5) / SAMPLES for count in camera.size_px)
    return camera.rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)).astype(np.float32)


def view(azimuth_deg: float, elevation_deg: float, range_m: float = 0.5, roll_deg: float = 0.0, at=(0.0, 0.0)):
    """A camera's pose that looks at a point of the table."""
    centre = np.array([*at, 0.0])
    eye = centre + range_m * direction(np.radians(azimuth_deg), np.radians(elevation_deg))
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return look_at(eye, centre) @ pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
