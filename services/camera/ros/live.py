"""A topic of ROS 2 as the source of images, live: heard on a Zenoh router as nodes with `rmw_zenoh` publish it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from saccade.services.camera.ros.calibration import info_topics
from saccade.services.camera.ros.choosing import Choice, Chooser
from saccade.services.camera.ros.storage import MAX_MESSAGE_BYTES, Raw
from saccade.services.camera.ros.stream import RosImage, RosPoses, Stream, poses_of
from saccade.services.camera.sources import ROS_PREFIX
from saccade.shared.config import CameraConfig, RosConfig
from saccade.shared.errors import SaccadeError
from saccade.shared.ros.keys import checked_topic, key_of, keys_of, parse_key
from saccade.shared.ros.session import open_ros
from saccade.shared.ros.types import ODOMETRY, POSE, READ, TF, require_types

if TYPE_CHECKING:
    import zenoh

FOUND_S = 10.0  # how long to wait for an image, its CameraInfo and a transform
SETTLED_S = 1.0  # how long the root of tf must be heard of
SILENT_S = 5.0  # after this time without an image the topic counts as ended
LOOK_S = 0.1
MOST_HELD, MOST_HELD_BYTES = 10_000, 2 * MAX_MESSAGE_BYTES  # of messages that have arrived and are not worked off


class Ears:
    """Holds the messages that arrive until they are worked off. What does not fit is dropped and counted."""

    def __init__(self) -> None:
        self.dropped = 0
        self._held: list[Raw] = []
        self._bytes = 0
        self._changed = threading.Condition()

    def hear(self, raw: Raw) -> None:
        """Takes a message. It is called on Zenoh's thread and never blocks."""
        size = len(raw.data or b"")
        with self._changed:
            if len(self._held) >= MOST_HELD or self._bytes + size > MOST_HELD_BYTES:
                self.dropped += 1
                return
            self._held.append(raw)
            self._bytes += size
            self._changed.notify()

    def heard(self, timeout_s: float) -> list[Raw]:
        """Returns what has arrived, and waits for at most `timeout_s` seconds if there is nothing."""
        with self._changed:
            if not self._held:
                self._changed.wait(timeout_s)
            held, self._held, self._bytes = self._held, [], 0
        return held


class LiveSource:
    """The newest image of a topic, with its pose, as often as it is asked for.

    Raises SaccadeError while it is iterated if no image, or none with a pose, comes for SILENT_S seconds.
    """

    endless = True

    def __init__(self, session: zenoh.Session, subscribers: list, ears: Ears, choice: Choice, chooser: Chooser,
                 rate_hz: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.name, self.size_px, self.period_s = f"{ROS_PREFIX}{choice.image}", choice.size_px, 1.0 / rate_hz
        self._session, self._subscribers, self._ears, self._clock = session, subscribers, ears, clock
        self._choice, self._stream = choice, Stream(choice, chooser.tree)

    @property
    def left_out(self) -> int:
        """How many messages could not be decoded or held."""
        return sum(self._stream.left_out.values()) + self._ears.dropped

    def __iter__(self) -> Iterator[RosImage]:
        heard_s = posed_s = self._clock()
        while True:
            for raw in self._ears.heard(LOOK_S):
                if self._choice.wants(raw.topic):
                    self._stream.take(raw)
                if raw.topic == self._choice.image:
                    heard_s = self._clock()
            image = self._stream.newest()
            now_s = self._clock()
            if image is not None and (image.world_from_camera is not None or not self._choice.path):
                yield image
                heard_s = posed_s = self._clock()  # the time between two frames is no silence
            elif now_s - heard_s > SILENT_S:
                raise SaccadeError(f"{self.name} gives no image: does the node that publishes it still run?")
            elif now_s - posed_s > SILENT_S:
                raise SaccadeError(f"{self.name}: for {SILENT_S:.0f} s no transform led from "
                                   f"{self._choice.camera_frame} to {self._choice.world_frame}: is tf still published?")
            elif image is not None:
                yield image

    def close(self) -> None:
        """Leaves the router."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._session.close()


def live_topic(text: str) -> str | None:
    """The topic in a source such as `ros:/camera/image_raw`. None for any other text. Raises SaccadeError if it is not
    a name of ROS."""
    return checked_topic(text.removeprefix(ROS_PREFIX)) if text.startswith(ROS_PREFIX) else None


def open_live_source(topic: str, camera: CameraConfig, ros: RosConfig) -> tuple[LiveSource, RosPoses, str]:
    """Listens to a topic of images, to its CameraInfo, and to tf. Returns the source, its poses, and a line that says
    what was taken.

    Raises SaccadeError if the router does not answer, if no image that can be decoded comes, or if no transform leads
    from the camera to the world.
    """
    require_types()
    session, ears = open_ros(ros), Ears()
    try:
        subscribers = _subscribed(session, ears, topic, camera, ros)
        chooser = Chooser(f"{ROS_PREFIX}{topic}", camera.model_copy(update={"image_topic": topic}))
        choice = _chosen(chooser, ears, topic)
    except BaseException:
        session.close()
        raise
    poses = poses_of(choice, "tf")
    source = LiveSource(session, subscribers, ears, choice, chooser, camera.rate_hz)
    return source, poses, f"ROS at {ros.router}: {choice.told}"


def _chosen(chooser: Chooser, ears: Ears, topic: str, clock: Callable[[], float] = time.monotonic) -> Choice:
    """Waits until it is clear what to take. Raises SaccadeError if it is not after FOUND_S.

    The root of tf is known only when all its parts were heard. So it waits longer if the world's frame is not given,
    and longer still if there are no intrinsics, or if no transform moves the camera.
    """
    camera, begun_s = chooser.camera, clock()
    found_s: float | None = None
    while clock() - begun_s < FOUND_S:
        for raw in ears.heard(LOOK_S):
            chooser.take(raw)
        try:
            choice = chooser.choose()
        except SaccadeError:
            continue
        found_s = clock() if found_s is None else found_s
        given = camera.intrinsics_px is not None or camera.calibration is not None
        lacks = not choice.moves or (choice.lens is None and not given)
        settled_s = FOUND_S / 2 if lacks else 0.0 if camera.world_frame or not choice.path else SETTLED_S
        if clock() - found_s >= settled_s:
            return choice
    if not chooser.images and not chooser.undecodable:
        raise SaccadeError(f"{ROS_PREFIX}{topic} gives no image: is its name right, does its node run with rmw_zenoh, "
                           f"and is this its router and domain (ros.router, ros.domain)? {chooser.seen} other "
                           "messages were heard")
    return chooser.choose()


def _subscribed(session: zenoh.Session, ears: Ears, topic: str, camera: CameraConfig, ros: RosConfig) -> list:
    import zenoh.ext

    def receive(sample: zenoh.Sample) -> None:
        heard = parse_key(str(sample.key_expr))
        if heard is None or heard.kind not in READ:
            return
        size = len(sample.payload)
        ears.hear(Raw(heard.topic, heard.kind, sample.payload.to_bytes() if size <= MAX_MESSAGE_BYTES else None,
                      time.time_ns()))

    keys = [keys_of(ros.domain, name) for name in (topic, *info_topics(topic))] + [key_of(ros.domain, "/tf", TF)]
    if camera.pose_topic is not None:
        keys += [key_of(ros.domain, checked_topic(camera.pose_topic), kind) for kind in (POSE, ODOMETRY)]
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)  # fixed transforms are published once
    return [*(session.declare_subscriber(key, receive) for key in keys),
            zenoh.ext.declare_advanced_subscriber(session, key_of(ros.domain, "/tf_static", TF), receive,
                                                  history=history)]
