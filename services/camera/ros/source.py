"""What of ROS 2 a camera can be: a bag, or a topic that is heard live."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from saccade.services.camera.poses import Poses
from saccade.services.camera.ros.bag import open_bag_source
from saccade.services.camera.ros.live import live_topic, open_live_source
from saccade.services.camera.ros.storage import is_bag
from saccade.services.camera.sources import Source
from saccade.shared.config import Config


def is_ros(text: str) -> bool:
    """Whether a source is a topic of ROS 2 or a bag. Raises SaccadeError like `live_topic`."""
    return live_topic(text) is not None or is_bag(Path(text))


@dataclass(frozen=True)
class RosSource:
    """A source of images, the poses that it tells itself, and a line that says what was taken."""

    source: Source
    poses: Poses
    told: str


def open_ros_source(config: Config) -> RosSource | None:
    """Opens the source of a configuration if it is one of ROS 2; otherwise returns None. Raises SaccadeError if it
    cannot be used."""
    text = config.camera.source or ""
    topic = live_topic(text)
    if topic is not None:
        return RosSource(*open_live_source(topic, config.camera, config.ros))
    return RosSource(*open_bag_source(Path(text), config.camera)) if is_bag(Path(text)) else None
