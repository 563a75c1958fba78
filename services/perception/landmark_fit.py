"""How an object must be turned and where it must be, so that its landmarks are where an image shows them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.services.perception.local_features import Features, mutual
from saccade.shared.model.bank import FILLED
from saccade.shared.model.landmarks import Landmarks
from saccade.shared.world.geometry import pose, project, unit

FEATURES = 600  # of a crop
QUICK_FEATURES, QUICK_LANDMARKS = 400, 2_000  # the surest, where one image after the other is seen
VOTING_FEATURES, VOTING_LANDMARKS = 300, 2_000  # the surest, which vote for an object
VOTE = 0.8  # what is more alike than this counts as a vote, by how much
FEWEST = 6  # landmarks that must be seen where they should be
CHECKED = 12  # landmarks that agree: with fewer a pose is not checked, and does not count as confirmed
SIDES_TRIED, QUICK_SIDES = 4, 2  # sides of an object that are tried
APART_RAD = 0.7  # sides that are tried lie so far from one another
NEAR_RAD = 1.0  # landmarks seen from within this of a tried side count with it
SEEN_RAD = 1.1  # an object is seen from within this of where the landmarks that agree were seen from
SIZE = 0.8  # logarithm of how much larger or smaller than its crop says an object may be
ERROR = 0.013  # so far from where it should be a landmark may be seen: a share of the crop's side
LOOSE = 1.5  # times so far where the pose is told by half of the landmarks
TRIES, TRIES_CHECKED = 500, 5_000  # poses that are tried, and where half of the landmarks tells one
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """A pose of an object, camera_from_object [4, 4], and how many landmarks are where it says, of how many that might
    be. The camera is that of the crop.

    Some landmarks always agree on something by chance. `confirmed` landmarks are where poses say that were found
    without them: these are about as many where the pose is right, and fewer where it is not.
    """

    camera_from_object: Array
    inliers: int
    matches: int
    confirmed: int = 0

    @property
    def support(self) -> float:
        """How many landmarks speak for the pose: the mean of those that agree and of those that confirm it."""
        return (self.inliers + self.confirmed) / 2


class LandmarkFit:
    """Fits the landmarks of one object."""

    def __init__(self, landmarks: Landmarks):
        self.points_m = landmarks.points_m.astype(np.float64)
        self.descriptors = landmarks.descriptors
        directions, seen = landmarks.directions, landmarks.seen
        self.apart = directions @ directions.T < np.cos(APART_RAD)  # [SIDES, SIDES]
        near = (directions @ directions.T > np.cos(NEAR_RAD)).astype(np.float32)
        self.around = near @ seen.astype(np.float32) > 0  # [SIDES, N]: the landmarks that are seen from near a side
        self.towards = seen.T @ directions  # [N, 3]: from where a landmark is seen, not of unit length
        self.radius_m = float(np.linalg.norm(landmarks.points_m, axis=1).max(initial=0.0))

    def votes(self, found: Features) -> float:
        """How much speaks for the object, seen from one side: a quick measure to choose what is worth a fit."""
        alike = found.descriptors[:VOTING_FEATURES].numpy() @ self.descriptors[:VOTING_LANDMARKS].T
        rows, which = mutual(alike)
        return float((self.around[:, which] * np.maximum(alike[rows, which] - VOTE, 0.0)).sum(1).max())

    def __call__(self, found: Features, focal_px: float, side_px: int, *, quick: bool = False) -> Fit | None:
        """The pose that most landmarks agree on, or None if too few do. The features are those of a square crop of
        `side_px` whose camera has the focal length `focal_px`. A quick fit looks at the surest of both."""
        features, landmarks = (QUICK_FEATURES, QUICK_LANDMARKS) if quick else (None, None)
        alike = found.descriptors[:features].numpy() @ self.descriptors[:landmarks].T
        if min(alike.shape) < FEWEST:
            return None
        around = self.around[:, :landmarks]
        votes = around[:, mutual(alike)[1]].sum(1)
        camera = {"model": "SIMPLE_PINHOLE", "width": side_px, "height": side_px,
                  "params": [focal_px, side_px / 2, side_px / 2]}
        best: tuple[Fit, Array, NDArray[np.int64]] | None = None
        for side in self._tried(votes, QUICK_SIDES if quick else SIDES_TRIED):
            near = np.flatnonzero(around[side])
            rows, which = mutual(alike.take(near, axis=1))
            pixels, shown = found.pixels.numpy()[rows].astype(np.float64), near[which]
            fit = self._fit(pixels, shown, camera)
            if fit and (best is None or fit.inliers > best[0].inliers):
                best = fit, pixels, shown
        if best is None:
            return None
        fit, pixels, shown = best
        return fit if fit.inliers < CHECKED else replace(fit, confirmed=self._confirmed(pixels, shown, camera))

    def _tried(self, votes: Array, count: int) -> list[int]:
        """The sides with the most of the votes [SIDES], which are not near one another."""
        votes, sides = votes.copy(), list[int]()
        while len(sides) < count and votes.max() > 0:
            sides.append(int(votes.argmax()))
            votes[~self.apart[sides[-1]]] = 0
        return sides

    def _confirmed(self, pixels: Array, which: NDArray[np.int64], camera: dict[str, Any]) -> int:
        """How many of the landmarks `which` [M], in two halves, are where the pose by the other half puts them."""
        count, middle, focal = 0, camera["width"] / 2, camera["params"][0]
        first = np.arange(len(which)) % 2 == 0
        for told_by in (first, ~first):
            told, _ = _agreed(pixels[told_by], self.points_m[which[told_by]], camera, TRIES_CHECKED)
            seen, depth = project(self.points_m[which[~told_by]], np.linalg.inv(told), (focal, focal, middle, middle))
            off = np.linalg.norm(seen - pixels[~told_by], axis=1)
            count += int(((off < LOOSE * ERROR * camera["width"]) & (depth > 0)).sum())
        return count

    def _fit(self, pixels: Array, which: NDArray[np.int64], camera: dict[str, Any]) -> Fit | None:
        """The pose that most of the landmarks `which` [M] agree on, if they are seen at `pixels` [M, 2]."""
        if len(which) < FEWEST:
            return None
        fitted, agree = _agreed(pixels, self.points_m[which], camera, TRIES)
        if agree.sum() < FEWEST or not self._fills(fitted, camera):
            return None
        if seen_from(fitted) @ unit(self.towards[which[agree]].sum(0)) < np.cos(SEEN_RAD):
            return None
        return Fit(fitted, int(agree.sum()), len(which))

    def _fills(self, camera_from_object: Array, camera: dict[str, Any]) -> bool:
        """Whether an object with this pose lies in the crop and fills about as much of it as things do."""
        right, up, back = camera_from_object[:3, 3]
        half = camera["width"] / 2 / camera["params"][0]
        if back >= 0.0 or np.hypot(right, up) > -back * half:
            return False
        return abs(np.log(self.radius_m / (-back * half * FILLED))) < SIZE


def _agreed(pixels: Array, points_m: Array, camera: dict[str, Any], tries: int) -> tuple[Array, NDArray[np.bool_]]:
    """The pose [4, 4] that most of the points [M, 3] agree on which are seen at `pixels` [M, 2], of so many tries, and
    which do [M]."""
    import poselib

    ransac = {"max_iterations": tries, "min_iterations": 30, "seed": 0, "max_reproj_error": ERROR * camera["width"]}
    told, info = poselib.estimate_absolute_pose(pixels, points_m, camera, ransac, {})
    return pose(OPENGL_FROM_OPENCV @ told.R, OPENGL_FROM_OPENCV @ told.t), np.array(info["inliers"], dtype=bool)


def seen_from(camera_from_object: Array) -> Array:
    """The direction [3] from an object to the camera, in the object's frame."""
    return -camera_from_object[:3, :3].T @ unit(camera_from_object[:3, 3])
