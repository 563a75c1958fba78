"""A ROS 2 bag as the source of images."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from saccade.services.camera.poses import Poses
from saccade.services.camera.ros.choosing import Choice, Chooser
from saccade.services.camera.ros.storage import Bag, open_bag
from saccade.services.camera.ros.stream import RosImage, Stream, poses_of
from saccade.services.camera.ros.transforms import TransformTree
from saccade.shared.config import CameraConfig
from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB
from saccade.shared.ros.types import NANOSECONDS, require_types

PROBED_NS, PROBED_BYTES = 5 * NANOSECONDS, 1024 * MIB  # of a bag's beginning, by which it is chosen what to take


class BagSource:
    """The images of a bag, with their poses. It reads the bag again each time it is iterated, and holds no more of it
    than a chunk and the images that wait for a transform.

    `left_out` counts the messages that could not be decoded.
    """

    endless = False

    def __init__(self, bag: Bag, choice: Choice, tree: TransformTree, rate_hz: float) -> None:
        self.name, self.size_px = str(bag.path), choice.size_px
        self.period_s = choice.period_s or 1.0 / rate_hz
        self._bag, self._choice, self._fixed = bag, choice, tree.fixed()
        self._left_out: Counter[str] = Counter()

    @property
    def left_out(self) -> int:
        """How many messages could not be decoded."""
        return sum(self._left_out.values())

    def __iter__(self) -> Iterator[RosImage]:
        choice = self._choice
        stream = Stream(choice, self._fixed.fixed(), self._left_out)
        for raw in self._bag.messages(choice.wants):
            stream.take(raw)
            yield from stream.ready()
        yield from stream.ready(last=True)
        if self._bag.cut:
            print(f"saccade: camera: {self._bag.cut}: what comes later is left out", file=sys.stderr, flush=True)


def open_bag_source(path: Path, camera: CameraConfig) -> tuple[BagSource, Poses, str]:
    """Opens a bag, and returns the source, its poses, and a line that says what was taken.

    Raises SaccadeError if it cannot be read, has no images, or if it is not clear what to take.
    """
    require_types()
    bag = open_bag(path)
    chooser = Chooser(f"bag {path}", camera)
    due_ns, read = None, 0
    for raw in bag.messages():
        chooser.take(raw)
        read += len(raw.data or b"")
        if due_ns is None or raw.time_ns > due_ns:
            if (due_ns is not None and chooser.complete) or read > PROBED_BYTES:
                break
            due_ns = raw.time_ns + PROBED_NS
    if not chooser.images and bag.cut:
        raise SaccadeError(f"bag {path} cannot be read: {bag.cut}, and no image comes before")
    choice = chooser.choose()
    poses = poses_of(choice, f"the transforms of {path}")
    return BagSource(bag, choice, chooser.tree, camera.rate_hz), poses, f"bag {path.name}: {choice.told}"
