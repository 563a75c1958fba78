"""The camera's pose from the corners of a board in one image, with its covariance. A doubtful pose is none.

A board seen from far away or nearly straight on may have been tilted one way or the other: both ways then explain the
corners about as well, and no pose is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.services.camera.charuco import Board, Corners
from saccade.services.camera.opencv import opencv
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.world.geometry import Array, pose, rotation_angle

LEAST_CORNERS = 8
OUTLIER_SHARE = 0.004  # of the image's width: a corner further from where the board has it was not found right
KEPT_SHARE = 0.7  # of the corners; if more of them are outliers, nothing is believed
LARGEST_RMS_SHARE = 0.0025  # of the image's width: 1.6 of 640 pixels
LEAST_SIGMA_PX = 0.3  # of a corner; fewer pixels than found right by chance
CLEARLY_BETTER = 30.0  # difference of chi squared between the two ways that a board may be tilted
SAME_RAD = np.radians(3.0)  # two solutions that are nearer to each other are one
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.006, np.radians(0.7)  # three of them are less than two centimetres
ROUNDS, STEP = 10, 1e-6  # of Gauss and Newton; of a numerical derivative (metres, radians)


@dataclass(frozen=True)
class Measured:
    """A camera's pose world_from_camera [4, 4] (OpenGL) in the board's frame. `covariance` [6, 6] is that of its
    position (metres) and of a small rotation after it, about the world's axes (radians). `rms_px` is the root mean
    square distance of `corners` corners from where the pose has them."""

    world_from_camera: Array
    covariance: Array
    rms_px: float
    corners: int


@dataclass(frozen=True)
class Doubtful:
    """Why an image has no pose."""

    reason: str


def measure(board: Board, corners: Corners, lens: Lens) -> Measured | Doubtful:
    """Returns the camera's pose, or why there is none. `lens` is that of the image, with its intrinsics and size.

    Raises SaccadeError if OpenCV is missing.
    """
    rays = lens.rays(corners.pixels)
    corners, rays = corners.of(~np.isnan(rays[:, 0])), rays[~np.isnan(rays[:, 0])]
    if len(rays) < LEAST_CORNERS:
        return Doubtful(f"fewer than {LEAST_CORNERS} corners of the board are found")
    if lens.size_px is None or lens.intrinsics_px is None:
        raise ValueError("a lens without a size: give it one with `at`")
    width, points = lens.size_px[0], board.corners_m[corners.ids]
    kept = _inliers(points, rays, OUTLIER_SHARE * width / lens.intrinsics_px[0])
    if kept.sum() < max(LEAST_CORNERS, KEPT_SHARE * len(kept)):
        return Doubtful("the corners do not lie on one plane: is the sheet bent, or the lens not calibrated?")
    return _judged(_both_ways(points[kept], rays[kept], corners.pixels[kept], lens), LARGEST_RMS_SHARE * width,
                   int(kept.sum()))


def _inliers(points: Array, rays: Array, limit: float) -> Array:
    """Which corners [N] agree with one homography from the board to the rays."""
    cv2 = opencv("boards need")
    cv2.setRNGSeed(0)
    _, mask = cv2.findHomography(points[:, :2], rays, cv2.RANSAC, limit)
    return np.zeros(len(points), dtype=bool) if mask is None else mask.ravel().astype(bool)


def _both_ways(points: Array, rays: Array, pixels: Array, lens: Lens) -> list[Measured]:
    """The two ways that a plane may be tilted, each brought to the smallest reprojection error; the better first."""
    cv2 = opencv("boards need")
    _, turns, places, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    found = []
    for turn, place in zip(turns, places, strict=True):
        camera_from_world = np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(turn)[0]
        start = pose(camera_from_world.T, -cv2.Rodrigues(turn)[0].T @ np.ravel(place))
        if np.isfinite(start).all() and (best := _refined(start, points, pixels, lens)) is not None:
            found.append(best)
    return sorted(found, key=lambda one: one.rms_px)


def _refined(start: Array, points: Array, pixels: Array, lens: Lens) -> Measured | None:
    """The pose of least squares near `start`, by Gauss and Newton. None if it does not exist."""
    here = start
    for _ in range(ROUNDS):
        errors, slopes = _errors(here, points, pixels, lens), _slopes(here, points, pixels, lens)
        if not (np.isfinite(errors).all() and np.isfinite(slopes).all()):
            return None
        step, *_ = np.linalg.lstsq(slopes, -errors, rcond=None)
        here = _moved(here, np.asarray(step, dtype=np.float64))
        if np.abs(step).max() < STEP:
            break
    errors, slopes = _errors(here, points, pixels, lens), _slopes(here, points, pixels, lens)
    information = slopes.T @ slopes
    if not np.isfinite(errors).all() or np.linalg.matrix_rank(information) < 6:
        return None
    sigma_px = max(LEAST_SIGMA_PX, float(np.sqrt((errors ** 2).sum() / (len(errors) - 6))))
    rms_px = float(np.sqrt((errors.reshape(-1, 2) ** 2).sum(1).mean()))
    covariance = np.asarray(sigma_px ** 2 * np.linalg.inv(information), dtype=np.float64)
    return Measured(here, covariance, rms_px, len(points))


def _moved(world_from_camera: Array, step: Array) -> Array:
    """A pose after a small movement [6]: metres, and radians about the world's axes."""
    turn = Rotation.from_rotvec(step[3:]).as_matrix()
    return pose(turn @ world_from_camera[:3, :3], world_from_camera[:3, 3] + step[:3])


def _errors(world_from_camera: Array, points: Array, pixels: Array, lens: Lens) -> Array:
    """Distances [2 N] in pixels of where the lens would show the points from where they were found."""
    local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    depth = np.where(local[:, 2] < -1e-6, -local[:, 2], np.nan)  # nothing is seen behind the camera
    return np.asarray((lens.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / depth[:, None]) - pixels).ravel())


def _slopes(world_from_camera: Array, points: Array, pixels: Array, lens: Lens) -> Array:
    """Derivatives [2 N, 6] of the errors by a small movement."""
    steps = STEP * np.eye(6)
    return np.stack([_errors(_moved(world_from_camera, step), points, pixels, lens)
                     - _errors(_moved(world_from_camera, -step), points, pixels, lens) for step in steps],
                    axis=1) / (2 * STEP)


def _judged(found: list[Measured], largest_rms_px: float, count: int) -> Measured | Doubtful:
    """The better solution if it can be believed."""
    if not found:
        return Doubtful("no pose explains the corners")
    best, *other = found
    if best.rms_px > largest_rms_px:
        return Doubtful(f"the corners are more than {largest_rms_px:.1f} pixels from where any pose has them: is the "
                        "camera calibrated, and the sheet flat?")
    if best.world_from_camera[2, 3] <= 0:
        return Doubtful("the camera would be below the board")
    if other and rotation_angle(best.world_from_camera[:3, :3], other[0].world_from_camera[:3, :3]) > SAME_RAD:
        variance = max(LEAST_SIGMA_PX, best.rms_px / np.sqrt(2)) ** 2
        if count * (other[0].rms_px ** 2 - best.rms_px ** 2) / variance < CLEARLY_BETTER:
            return Doubtful("the board may be tilted either way: go nearer, or look at it from the side")
    return certain(best)


def certain(measured: Measured) -> Measured | Doubtful:
    """The same pose, or that its covariance is too large."""
    sigma_m, sigma_rad = (float(np.sqrt(np.linalg.eigvalsh(measured.covariance[k:k + 3, k:k + 3]).max()))
                          for k in (0, 3))
    if sigma_m > MAX_SIGMA_M or sigma_rad > MAX_SIGMA_RAD:
        return Doubtful("the board is seen too small, or too little of it: go nearer, or look at it from higher up")
    return measured
