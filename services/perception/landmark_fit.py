"""How an object must be turned and where it must be, so that its landmarks are where an image shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.local_features import Features
from saccade.shared.model.bank import FILLED
from saccade.shared.model.landmarks import STEP, Landmarks
from saccade.shared.world.geometry import pose, unit

FEATURES = 400  # of a crop
ALIKE = 0.7  # the least product of two descriptors that may be the same landmark
SUREST = 48  # landmarks of each view that vote
FEWEST = 6  # landmarks that must be seen where they should be
VIEWS_TRIED = 2  # views of an object that are tried as its own
NEAR_RAD = 1.0  # landmarks of views within this of a tried one count with it
SEEN_RAD = 1.1  # an object is seen from within this of where the landmarks that agree were seen from
SIZE = 0.8  # logarithm of how much larger or smaller than its crop says an object may be
ERROR_PX = 2.5  # so far from where it should be a landmark may be seen
RANSAC = {"max_reproj_error": ERROR_PX, "max_iterations": 500, "min_iterations": 30, "seed": 0}
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """A pose of an object, camera_from_object [4, 4], and how many landmarks are where it says, of how many that might
    be. The camera is that of the crop."""

    camera_from_object: Array
    inliers: int
    matches: int


class LandmarkFit:
    """Fits the landmarks of one object."""

    def __init__(self, landmarks: Landmarks):
        self.points_m = landmarks.points_m.astype(np.float64)
        there = np.arange(landmarks.points_m.shape[1]) < landmarks.counts[:, None]
        self.descriptors = torch.from_numpy(landmarks.descriptors).float() * STEP
        self.missing = torch.from_numpy(~there)
        directions = landmarks.directions
        self.directions, self.radius_m = directions, float(np.linalg.norm(landmarks.points_m, axis=-1).max())
        self.near = torch.from_numpy(directions @ directions.T > np.cos(NEAR_RAD)).float()

    @torch.inference_mode()
    def matches(self, found: Features) -> tuple[Tensor, Tensor]:
        """For each of the N features and each of the V views the number of its landmark [N, V], and whether the two
        are each other's likest [N, V]."""
        alike = (found.descriptors @ self.descriptors.flatten(0, 1).T).unflatten(1, self.missing.shape)
        alike = alike.masked_fill(self.missing, -1.0)
        best, which = alike.max(2)
        back = alike.argmax(0)  # [V, K]: the likest feature of each landmark
        mutual = torch.arange(len(which))[:, None] == back.gather(1, which.T).T
        return which, mutual & (best > ALIKE)

    @torch.inference_mode()
    def votes(self, found: Features, most: int) -> float:
        """About how many of the `most` surest features may be landmarks that are seen from one side, by the surest
        landmarks of each view."""
        surest = self.descriptors[:, :SUREST]
        alike = (found.descriptors[:most] @ surest.flatten(0, 1).T).unflatten(1, surest.shape[:2])
        alike = alike.masked_fill(self.missing[:, :SUREST], -1.0)
        best, which = alike.max(2)
        mutual = torch.arange(len(which))[:, None] == alike.argmax(0).gather(1, which.T).T
        return float(((mutual & (best > ALIKE)).float().sum(0) @ self.near).max())

    def __call__(self, found: Features, focal_px: float, side_px: int) -> Fit | None:
        """The pose that most landmarks agree on, or None if too few do. The features are those of a square crop of
        `side_px` whose camera has the focal length `focal_px`."""
        if len(found.pixels) < FEWEST:
            return None
        which, mutual = self.matches(found)
        votes = (mutual.float().sum(0) @ self.near) * (mutual.sum(0) > 0)
        camera = {"model": "SIMPLE_PINHOLE", "width": side_px, "height": side_px,
                  "params": [focal_px, side_px / 2, side_px / 2]}
        best: Fit | None = None
        for view in votes.topk(min(VIEWS_TRIED, len(votes))).indices.tolist():
            fit = self._fit(found, which, mutual, view, camera)
            if fit and (best is None or fit.inliers > best.inliers):
                best = fit
        return best

    def _fit(self, found: Features, which: Tensor, mutual: Tensor, view: int,
             camera: dict[str, Any]) -> Fit | None:
        """The pose that most landmarks of the views around one agree on."""
        import poselib

        rows, views = (each.numpy() for each in torch.nonzero(mutual & (self.near[view] > 0), as_tuple=True))
        if len(rows) < FEWEST:
            return None
        pixels, points = found.pixels.double().numpy()[rows], self.points_m[views, which.numpy()[rows, views]]
        told, info = poselib.estimate_absolute_pose(pixels, points, camera, RANSAC, {})
        agree = np.array(info["inliers"], dtype=bool)
        fitted = pose(OPENGL_FROM_OPENCV @ told.R, OPENGL_FROM_OPENCV @ told.t)
        count = len(np.unique(rows[agree]))
        if count < FEWEST or not self._fills(fitted, camera):
            return None
        towards = unit(self.directions[views[agree]].sum(0))
        if seen_from(fitted) @ towards < np.cos(SEEN_RAD):
            return None
        return Fit(fitted, count, len(np.unique(rows)))

    def _fills(self, camera_from_object: Array, camera: dict[str, Any]) -> bool:
        """Whether an object with this pose lies in the crop and fills about as much of it as things do."""
        right, up, back = camera_from_object[:3, 3]
        half = camera["width"] / 2 / camera["params"][0]
        if back >= 0.0 or np.hypot(right, up) > -back * half:
            return False
        return abs(np.log(self.radius_m / (-back * half * FILLED))) < SIZE


def seen_from(camera_from_object: Array) -> Array:
    """The direction [3] from an object to the camera, in the object's frame."""
    return -camera_from_object[:3, :3].T @ unit(camera_from_object[:3, 3])
