"""The message types of ROS 2 that are read and written, and their encoding (CDR).

The definitions are those that come with `rosbags`. What a bag itself says about its types is not used, because these
types are the same in all distributions of ROS 2.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any

from saccade.shared.errors import SaccadeError, printable

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF, POSE, ODOMETRY = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"
MARKERS = "visualization_msgs/msg/MarkerArray"
IMAGES = (IMAGE, COMPRESSED)
READ = (*IMAGES, CAMERA_INFO, TF, POSE, ODOMETRY)

NANOSECONDS = 1_000_000_000
MAX_REASON = 100  # characters of what the decoder says


class RosError(ValueError):
    """A message is not one of its type, or holds what cannot be used. The text says why."""


@cache
def _types() -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise SaccadeError(f"ROS messages need rosbags ({error}): pip install 'saccade[ros]'") from error
    return get_typestore(Stores.ROS2_JAZZY)


def require_types() -> None:
    """Raises SaccadeError if the packages for ROS messages are not installed."""
    _types()


def decode(kind: str, data: bytes) -> Any:
    """Returns the message of type `kind` (`pkg/msg/Name`) in CDR bytes. Its arrays are views of `data`. Raises RosError
    if the bytes are no such message."""
    types = _types()
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise RosError("it does not begin like a message in CDR")
    try:
        return types.deserialize_cdr(memoryview(data), kind)
    except _damage() as error:
        raise RosError(f"it is cut or damaged ({printable(str(error) or type(error).__name__, MAX_REASON)})") from error


@cache
def _damage() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    return (SerdeError, ValueError, TypeError, IndexError, AssertionError, struct.error, OverflowError, MemoryError)


def encode(kind: str, message: Any) -> bytes:
    """Returns a message of type `kind`, made by `make`, as CDR bytes."""
    return bytes(_types().serialize_cdr(message, kind))


def make(kind: str, fields: Mapping[str, Any] | None = None) -> Any:
    """Returns a message of type `kind` with these fields. Raises TypeError if one is missing or unknown."""
    return _types().types[kind](**(fields or {}))


@cache
def hash_of(kind: str) -> str:
    """The hash of a type's definition, as ROS 2 writes it (`RIHS01_...`)."""
    return str(_types().hash_rihs01(kind))


def stamp_ns(header: Any) -> int:
    """The stamp of a message's header, in nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)
