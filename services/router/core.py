"""The router: a Zenoh session that listens for connections. If it is restarted, the other services connect again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from saccade.shared.bus.transport import ZenohBus
from saccade.shared.config import Config
from saccade.shared.loop.process import Health, Heartbeat, Inbox, run_process

NAME = "router"


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the router's process. Its exit code is 2 if the endpoint is in use already."""
    run_process(NAME, _work, argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    bus = ZenohBus(config.bus.listen or config.bus.endpoint, world=config.bus.world, listen=True)
    try:
        health = Health(NAME, at=(config.run or folder.name, 0, 0))
        with Heartbeat(bus, health, inbox.stop):
            health.say("ready")
            for _ in inbox.items(drain_s=0.0):
                pass
    finally:
        bus.close()
