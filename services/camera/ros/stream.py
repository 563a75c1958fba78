"""Turns messages of ROS, as they come, into images with the camera's pose at their stamp."""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.poses import Poses
from saccade.services.camera.ros.choosing import Choice, add_transforms
from saccade.services.camera.ros.pixels import rgb_of
from saccade.services.camera.ros.storage import Raw
from saccade.services.camera.ros.transforms import TransformTree
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories.trajectory import EPOCH_S
from saccade.shared.errors import printable
from saccade.shared.files import MIB
from saccade.shared.ros.types import NANOSECONDS, RosError, decode, stamp_ns
from saccade.shared.world.geometry import Array

OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])  # ROS: z forward and y down; Saccade: z backward and y up
WAIT_NS = NANOSECONDS  # how much later the newest stamp may be than an image that waits for its transform
MOST_WAITING, MOST_WAITING_BYTES = 300, 256 * MIB


@dataclass(frozen=True)
class RosImage(SourceImage):
    """An image with its pose world_from_camera [4, 4] (OpenGL). The pose is None if it is not known."""

    world_from_camera: Array | None = None


@dataclass
class _Waiting:
    """An image whose pose is not known yet."""

    message: Any
    time_ns: int
    size: int


class Stream:
    """Takes messages in about the order of time, and yields images with poses in the order of their messages.

    An image waits until every transform is known at its stamp, but not longer than for images that are a second
    newer. Messages that cannot be decoded are counted in `left_out`, by topic; the first reason of each is printed.
    """

    def __init__(self, choice: Choice, tree: TransformTree, left_out: Counter[str] | None = None) -> None:
        self.choice, self.tree = choice, tree
        self.left_out = Counter() if left_out is None else left_out
        self._waiting: deque[_Waiting] = deque()
        self._bytes, self._newest_ns, self._index = 0, 0, 0
        self._first_ns: int | None = None

    def take(self, raw: Raw) -> None:
        """Takes a message of a chosen topic, or of tf."""
        try:
            if raw.topic != self.choice.image:
                add_transforms(self.tree, raw, self.choice.pose_frame)
                return
            if raw.data is None:
                raise RosError("it is too large or damaged")
            message = decode(raw.kind, raw.data)
            time_ns = stamp_ns(message.header) or raw.time_ns
            set_back = time_ns < self._newest_ns - WAIT_NS  # as when a simulation begins anew
            self._newest_ns = time_ns if set_back else max(self._newest_ns, time_ns)
            self._bytes += len(raw.data)
            self._waiting.append(_Waiting(message, time_ns, len(raw.data)))
        except RosError as error:
            self.leave_out(raw.topic, error)

    def ready(self, *, last: bool = False) -> Iterator[RosImage]:
        """Yields the images that need not wait any longer, or with `last` all."""
        while self._waiting and (last or self._is_ready(self._waiting[0])):
            waiting = self._waiting.popleft()
            self._bytes -= waiting.size
            image = self._image(waiting)
            if image is not None:
                yield image

    def newest(self) -> RosImage | None:
        """Returns the newest image that need not wait any longer, and drops those before it. None if there is none."""
        for k in range(len(self._waiting) - 1, -1, -1):
            if self._is_ready(self._waiting[k]):
                for _ in range(k):
                    self._bytes -= self._waiting.popleft().size
                return next(self.ready(), None)
        return None

    def leave_out(self, topic: str, reason: object) -> None:
        """Counts a message that cannot be used, and prints the reason if it is the first of its topic."""
        if not self.left_out[topic]:
            print(f"saccade: camera: a message is left out: {printable(topic, 100)}: {reason}", file=sys.stderr,
                  flush=True)
        self.left_out[topic] += 1

    def _is_ready(self, waiting: _Waiting) -> bool:
        choice = self.choice
        return (not choice.path or self.tree.reaches(choice.world_frame, choice.camera_frame, waiting.time_ns)
                or self._newest_ns - waiting.time_ns > WAIT_NS or self._newest_ns < waiting.time_ns
                or len(self._waiting) > MOST_WAITING or self._bytes > MOST_WAITING_BYTES)

    def _image(self, waiting: _Waiting) -> RosImage | None:
        choice = self.choice
        try:
            rgb: NDArray[np.uint8] = rgb_of(choice.kind, waiting.message)
            if rgb.shape[:2] != choice.size_px[::-1]:
                raise RosError(f"an image of {rgb.shape[1]}x{rgb.shape[0]} pixels among images of {choice.size_px[0]}x"
                               f"{choice.size_px[1]}")
        except RosError as error:
            self.leave_out(choice.image, error)
            return None
        self._first_ns = waiting.time_ns if self._first_ns is None else self._first_ns
        pose = self.tree.at(choice.world_frame, choice.camera_frame, waiting.time_ns) if choice.path else None
        name = str(waiting.time_ns) if waiting.time_ns >= EPOCH_S * NANOSECONDS else ""
        self._index += 1
        return RosImage(rgb, self._index - 1, (waiting.time_ns - self._first_ns) / NANOSECONDS, name,
                        None if pose is None else pose @ OPTICAL)


@dataclass(frozen=True)
class RosPoses(Poses):
    """The poses that images of ROS carry themselves, and the lens of a CameraInfo."""

    def of(self, image: SourceImage) -> Array | None:
        """The pose [4, 4] that the image carries. None if it is not known."""
        return image.world_from_camera if isinstance(image, RosImage) else None

    def end_before(self, image: SourceImage) -> bool:
        """A later image can always have a pose."""
        return False

    def __str__(self) -> str:
        return self.name


def poses_of(choice: Choice, name: str) -> RosPoses:
    """The poses of what was chosen. `name` names them in errors."""
    return RosPoses({}, name, lenses=(choice.lens,) if choice.lens else (), lens_from=choice.info or "")


def with_lens(poses: Poses, other: Poses) -> Poses:
    """The poses of a file, with the lens of a CameraInfo if the file tells none."""
    return poses if poses.lenses else replace(poses, lenses=other.lenses, lens_from=other.lens_from)
