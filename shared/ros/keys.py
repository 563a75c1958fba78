"""How ROS 2 uses Zenoh when its middleware is `rmw_zenoh`: keys, liveliness tokens and attachments.

A topic has the key `<domain>/<topic>/<type>/<hash of the type>`. Every node and every publisher declares a liveliness
token, by which `ros2 topic list` knows it. Every message carries its number, its time and who sent it.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from saccade.shared.errors import SaccadeError, told
from saccade.shared.wording import ROS_NAME

ADMIN = "@ros2_lv"
NODE, PUBLISHER = "NN", "MP"
DEFAULT_QOS = "::,:,:,:,,"  # reliable, volatile, keeps the last: nothing differs from the default of rmw_zenoh
ANY_HASH = "*"
GID_BYTES = 16
_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::msg::dds_::([A-Za-z][A-Za-z0-9_]*)_")


class Heard(NamedTuple):
    """What a key says: a topic (`/camera/image_raw`) and the type of its messages (`sensor_msgs/msg/Image`)."""

    topic: str
    kind: str


def checked_topic(topic: str) -> str:
    """Returns the name of a topic. Raises SaccadeError if it is not an absolute name of ROS."""
    if re.fullmatch(ROS_NAME, topic) is None:
        raise SaccadeError(f"topic {told(topic)} is not a name of ROS: give one such as /camera/image_raw")
    return topic


def key_of(domain: int, topic: str, kind: str, type_hash: str = ANY_HASH) -> str:
    """The key of a topic. Without a hash it is a key expression for all distributions of ROS 2."""
    return f"{domain}/{topic.strip('/')}/{_dds(kind)}/{type_hash}"


def keys_of(domain: int, topic: str) -> str:
    """The key expression of a topic of any type."""
    return f"{domain}/{topic.strip('/')}/*/*"


def parse_key(key: str) -> Heard | None:
    """What a key says. Returns None if it is no key of a ROS topic."""
    parts = key.split("/")
    match = _TYPE.fullmatch(parts[-2]) if len(parts) >= 4 else None
    return Heard("/" + "/".join(parts[1:-2]), f"{match[1]}/msg/{match[2]}") if match else None


def node_token(domain: int, session: str, node: str) -> str:
    """The liveliness token of a node. `session` is the id of its Zenoh session."""
    return f"{ADMIN}/{domain}/{session}/0/0/{NODE}/%/%/{node}"


def publisher_token(domain: int, session: str, node: str, number: int, topic: str, kind: str, type_hash: str) -> str:
    """The liveliness token of a node's publisher. `number` tells its publishers apart, from 1."""
    return (f"{ADMIN}/{domain}/{session}/0/{number}/{PUBLISHER}/%/%/{node}/{topic.replace('/', '%')}/{_dds(kind)}/"
            f"{type_hash}/{DEFAULT_QOS}")


def attachment(number: int, time_ns: int, gid: bytes) -> bytes:
    """What is sent beside a message: its number from 1, its time since 1970, and the 16 bytes that name its publisher.
    The receivers of rmw_zenoh refuse messages without it."""
    if len(gid) != GID_BYTES:
        raise ValueError(f"a publisher's id has {GID_BYTES} bytes, not {len(gid)}")
    return number.to_bytes(8, "little", signed=True) + time_ns.to_bytes(8, "little", signed=True) + \
        bytes([GID_BYTES]) + gid


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"
