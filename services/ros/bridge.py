"""The bridge's process: it listens to the agent, and publishes to ROS 2 as a node with `rmw_zenoh` does."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade.services.ros.core import Teller
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.config import Config, RosConfig
from saccade.shared.loop.process import Health, Heartbeat, Inbox, messages_of, run_process
from saccade.shared.ros.keys import GID_BYTES, attachment, key_of, node_token, publisher_token
from saccade.shared.ros.session import open_ros
from saccade.shared.ros.types import MARKERS, POSE, encode, hash_of, require_types

if TYPE_CHECKING:
    import zenoh

NAME = "ros"
NODE = "saccade"
WORLD = "world"  # the frame of the viewpoint if the configuration names none
QUEUE_BYTES = 64 * 1024 * 1024  # of messages that wait; what does not fit is dropped
PUBLISHED = {POSE: "viewpoint", MARKERS: "beliefs"}


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the bridge's process. Its exit code is 2 if the router of ROS 2 does not answer."""
    run_process(NAME, _work, inbox=Inbox(QUEUE_BYTES), argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    require_types()
    health = Health(NAME, at=(config.run or folder.name, 0, 0))
    with (closing(Node(config.ros)) as node,
          closing(ZenohBus(config.bus.endpoint, world=config.bus.world, onlooker=True)) as bus,
          Heartbeat(bus, health, inbox.stop)):
        teller = Teller(config.scene.names or (), config.camera.world_frame or WORLD)
        bus.subscribe(teller.topics, inbox.put)
        health.say("ready", f"publishes {' and '.join(node.topics)} at {config.ros.router}")
        bridge(teller, node, inbox, health)


def bridge(teller: Teller, node: Node, inbox: Inbox, health: Health,
           clock_ns: Callable[[], int] = time.time_ns) -> None:
    """Passes on the messages of the run that `health` names, once each, until the inbox is stopped."""
    sequences = Sequences()
    for topic, part, message in messages_of(inbox, health):
        if sequences.take(topic, part, message) is None:
            continue
        health.at = (message.run, message.episode, message.step)
        for kind, content in teller.take(message, clock_ns()):
            node.publish(kind, content, clock_ns())
            health.published += 1


class Node:
    """A node of ROS 2 with a publisher for each of PUBLISHED. Raises SaccadeError if the router does not answer."""

    def __init__(self, ros: RosConfig) -> None:
        self.topics = tuple(f"{ros.namespace}/{name}" for name in PUBLISHED.values())
        self._session: zenoh.Session = open_ros(ros)
        session, liveliness = str(self._session.zid()), self._session.liveliness()
        self._tokens = [liveliness.declare_token(node_token(ros.domain, session, NODE))]
        self._publishers: dict[str, tuple[zenoh.Publisher, bytes]] = {}
        self._sent = dict.fromkeys(PUBLISHED, 0)
        for number, (kind, topic) in enumerate(zip(PUBLISHED, self.topics, strict=True), start=1):
            token = publisher_token(ros.domain, session, NODE, number, topic, kind, hash_of(kind))
            publisher = self._session.declare_publisher(key_of(ros.domain, topic, kind, hash_of(kind)))
            self._publishers[kind] = publisher, hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
            self._tokens.append(liveliness.declare_token(token))

    def publish(self, kind: str, content: Any, time_ns: int) -> None:
        """Publishes a message of that type. Nobody is waited for."""
        publisher, gid = self._publishers[kind]
        self._sent[kind] += 1
        publisher.put(encode(kind, content), attachment=attachment(self._sent[kind], time_ns, gid))

    def close(self) -> None:
        """Leaves ROS 2."""
        for token in self._tokens:
            token.undeclare()
        self._session.close()
