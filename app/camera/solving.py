"""Intrinsics and distortion of a camera from views of a board, and how certain they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from saccade.services.camera.calibration import Calibration
from saccade.services.camera.charuco import Board, Corners
from saccade.services.camera.opencv import opencv
from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import Array
from saccade.shared.world.images import Size

Model = Literal["pinhole", "fisheye"]

LEAST_VIEWS, MOST_VIEWS = 8, 40
LEAST_CORNERS, LEAST_SHARE = 8, 0.25  # of the corners, for a view to be of use
APART = 0.04  # of the image's width: views whose boards are nearer to each other are one view
LARGEST_SIGMA = 0.01  # of the focal length, as a share; views that are too alike leave it open
LARGEST_RMS = 0.003  # of the image's width
BAD_VIEW, BAD_CORNER = 2.5, 5.0  # times the median error of views, and of corners
HOW = "film the board from many sides, tilted by up to 45 degrees, in every part of the image"


@dataclass(frozen=True)
class View:
    """The corners of the board in one image, and the image's name."""

    name: str
    corners: Corners


@dataclass(frozen=True)
class Solved:
    """A calibration, the `views` that it rests on, their `residuals` [N, 2] in pixels (found less explained), and the
    standard deviation of the focal length as a share of it."""

    calibration: Calibration
    views: tuple[View, ...]
    residuals: tuple[Array, ...]
    focal_sigma: float


def is_of_use(board: Board, corners: Corners) -> bool:
    """Whether a view shows enough of the board."""
    enough = len(corners.ids) >= max(LEAST_CORNERS, LEAST_SHARE * board.usable.sum())
    return enough and _outline(board, corners) is not None


def _outline(board: Board, corners: Corners) -> Array | None:
    """Where the four corners of the whole board would be [4, 2] in pixels. None if all that is seen lies on a line."""
    points = board.corners_m[corners.ids][:, :2]
    if np.linalg.svd(points - points.mean(0), compute_uv=False)[1] < board.square_m:
        return None
    found, _ = opencv("calibrations need").findHomography(points, corners.pixels)
    if found is None:
        return None
    half = board.size_m / 2
    ends = np.array([[x, y, 1.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])]) @ found.T
    return ends[:, :2] / ends[:, 2:] if (np.abs(ends[:, 2]) > 1e-9).all() else None


def spread(board: Board, views: Sequence[View], size_px: Size, most: int = MOST_VIEWS) -> list[View]:
    """Chooses views that differ most: each next one is the farthest from those that are chosen. Two views that are
    nearer than APART are not both chosen."""
    outlines = np.array([_outline(board, view.corners) for view in views]).reshape(len(views), 4, 2) / size_px[0]
    chosen: list[int] = []
    distance = np.full(len(views), np.inf)
    next_one = int(np.argmax([len(view.corners.ids) for view in views])) if views else -1
    while views and len(chosen) < most and distance[next_one] > APART:
        chosen.append(next_one)
        distance = np.minimum(distance, np.linalg.norm(outlines - outlines[next_one], axis=2).mean(1))
        next_one = int(distance.argmax())
    return [views[k] for k in sorted(chosen)]


def solve(board: Board, views: Sequence[View], size_px: Size, model: Model) -> Solved:
    """Finds intrinsics and distortion from views of use. Corners and views with much larger errors than the others
    are left out.

    Raises SaccadeError if there are too few views, if they are too alike, or if no lens explains them.
    """
    chosen = spread(board, views, size_px)
    if len(chosen) < LEAST_VIEWS:
        raise SaccadeError(f"{len(views)} images show the board, of which {len(chosen)} differ enough, and "
                           f"{LEAST_VIEWS} are needed: {HOW}")
    solved = _solved(board, chosen, size_px, model)
    good = _good(board, solved)
    if len(good) >= LEAST_VIEWS:
        solved = _solved(board, good, size_px, model)
    if not solved.focal_sigma <= LARGEST_SIGMA:  # also if it is NaN
        raise SaccadeError(f"the {len(solved.views)} views are too alike: they leave the focal length open by "
                           f"{solved.focal_sigma:.1%}; {HOW}")
    if (solved.calibration.rms_px or 0.0) > LARGEST_RMS * size_px[0]:
        raise SaccadeError(f"no {model} lens explains the views: {solved.calibration.rms_px:.1f} pixels are left; is "
                           "it the printed board that the file describes, and is it flat? Try the other --model")
    return solved


def _good(board: Board, solved: Solved) -> list[View]:
    """The views without the corners that were not found right, and without those whose errors are much larger."""
    distances = [np.linalg.norm(rest, axis=1) for rest in solved.residuals]
    usual = BAD_CORNER * float(np.median(np.concatenate(distances)))
    kept = [View(view.name, view.corners.of(distance <= usual))
            for view, distance in zip(solved.views, distances, strict=True)]
    errors = np.array([np.median(distance) for distance in distances])
    return [view for view, error in zip(kept, errors, strict=True)
            if error <= BAD_VIEW * np.median(errors) and is_of_use(board, view.corners)]


def _solved(board: Board, views: Sequence[View], size_px: Size, model: Model) -> Solved:
    cv2 = opencv("calibrations need")
    points = [board.corners_m[view.corners.ids][:, None] for view in views]
    pixels = [view.corners.pixels[:, None] - 0.5 for view in views]  # OpenCV counts from the centre of the first pixel
    try:
        matrix, distortion, turns, places = (_fisheye if model == "fisheye" else _pinhole)(cv2, points, pixels, size_px)
    except cv2.error as error:
        raise SaccadeError(f"no {model} lens explains the views ({str(error.err).strip()[:120]}): {HOW}") from error
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    residuals, slopes = zip(*(_explained(cv2, model, matrix, distortion, *one)
                              for one in zip(points, pixels, turns, places, strict=True)), strict=True)
    rms_px = float(np.sqrt((np.concatenate(residuals) ** 2).sum(1).mean()))
    try:
        calibration = Calibration(size_px=size_px, model=model, intrinsics_px=(fx, fy, cx, cy),
                                  distortion=tuple(map(float, np.ravel(distortion))), rms_px=rms_px, views=len(views))
    except ValueError as error:
        raise SaccadeError(f"no {model} lens explains the views: {HOW}") from error
    return Solved(calibration, tuple(views), residuals, _focal_sigma(slopes, rms_px) / fx)


def _pinhole(cv2: Any, points: list[Array], pixels: list[Array], size_px: Size) -> tuple[Array, Array, Any, Any]:
    _, matrix, distortion, turns, places = cv2.calibrateCamera(
        [p.astype(np.float32) for p in points], [p.astype(np.float32) for p in pixels], size_px, None, None)
    return matrix, np.ravel(distortion)[:5], turns, places


def _fisheye(cv2: Any, points: list[Array], pixels: list[Array], size_px: Size) -> tuple[Array, Array, Any, Any]:
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    _, matrix, distortion, turns, places = cv2.fisheye.calibrate(
        [p.reshape(1, -1, 3) for p in points], [p.reshape(1, -1, 2) for p in pixels], size_px, None, None, flags=flags)
    return matrix, np.ravel(distortion), turns, places


def _explained(cv2: Any, model: Model, matrix: Array, distortion: Array, points: Array, pixels: Array, turn: Array,
               place: Array) -> tuple[Array, tuple[Array, Array]]:
    """The residuals [N, 2] of a view, and their derivatives [2 N, K] by the lens and [2 N, 6] by the pose."""
    if model == "fisheye":
        shown, slopes = cv2.fisheye.projectPoints(points, turn, place, matrix, distortion)
        of_lens, of_pose = slopes[:, :8], slopes[:, 8:14]
    else:
        shown, slopes = cv2.projectPoints(points, turn, place, matrix, distortion)[:2]
        of_lens, of_pose = slopes[:, 6:], slopes[:, :6]
    return (pixels - shown.reshape(-1, 1, 2)).reshape(-1, 2), (of_lens, of_pose)


def _focal_sigma(slopes: Sequence[tuple[Array, Array]], rms_px: float) -> float:
    """The standard deviation of fx in pixels, with the poses of all views unknown. NaN if it is not determined."""
    information = np.zeros((slopes[0][0].shape[1],) * 2)
    for of_lens, of_pose in slopes:
        rest = of_lens - of_pose @ np.linalg.pinv(of_pose) @ of_lens  # what no change of the pose makes up for
        information += rest.T @ rest
    try:
        variance = float(np.linalg.inv(information)[0, 0])
    except np.linalg.LinAlgError:
        return float("nan")
    return float(np.sqrt(variance) * rms_px / np.sqrt(2)) if variance >= 0 else float("nan")
