"""The lens that a CameraInfo tells of."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from saccade.services.camera.trajectories.lens import Lens, lens
from saccade.shared.ros.types import RosError

NAMES = {  # of the coefficients in `d`, by the model
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"), "fisheye": ("k1", "k2", "k3", "k4"),
}
FISHEYE = ("equidistant", "fisheye")
TRANSPORTS = ("compressed", "ffmpeg", "theora", "zstd")  # what image_transport appends to a topic
INFO = "camera_info"


def lens_of(info: Any, *, rectified: bool) -> Lens:
    """The lens of a CameraInfo. A `rectified` image has the intrinsics of its projection matrix, and no distortion.

    ROS counts pixels from the centre of the first one, as OpenCV does, and Saccade from its corner. Raises RosError if
    the camera is not calibrated, or if no camera has such numbers.
    """
    matrix = np.asarray(info.p, dtype=np.float64).reshape(3, 4) if rectified else \
        np.asarray(info.k, dtype=np.float64).reshape(3, 3)
    if not matrix[0, 0]:
        raise RosError("the camera is not calibrated: its focal length is 0")
    roi = info.roi
    numbers = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2] + 0.5 - roi.x_offset,
               "cy": matrix[1, 2] + 0.5 - roi.y_offset}
    model = str(info.distortion_model)
    if not rectified and np.any(np.asarray(info.d)):
        if model not in NAMES or len(info.d) < len(NAMES[model]) - (model == "plumb_bob"):
            raise RosError(f"{len(info.d)} coefficients of the distortion '{model[:40]}' are not known; known are "
                           f"{', '.join(NAMES)}")
        numbers |= dict(zip(NAMES[model], map(float, info.d), strict=False))
    size_px = (float(roi.width or info.width), float(roi.height or info.height))
    try:
        return lens(numbers, size_px, fisheye=not rectified and model in FISHEYE and len(info.d) > 0)
    except ValueError as error:
        raise RosError(str(error)) from error


def is_rectified(topic: str) -> bool:
    """Whether a topic's images are rectified, by the name that ROS gives such topics."""
    return "rect" in base_of(topic).rsplit("/", 1)[-1]


def base_of(topic: str) -> str:
    """The topic of the images themselves, of which image_transport may publish compressed ones."""
    head, _, tail = topic.rpartition("/")
    return head if tail in TRANSPORTS else topic


def info_topics(image: str) -> tuple[str, str]:
    """The topics on which the CameraInfo of a topic of images can be, the usual one first."""
    base = base_of(image)
    return f"{base.rpartition('/')[0]}/{INFO}", f"{base}/{INFO}"


def info_topic(image: str, infos: Collection[str]) -> str | None:
    """The topic of the CameraInfo that belongs to a topic of images, among `infos`."""
    return next((name for name in info_topics(image) if name in infos), None)
