"""Our bus as the services use it. A client keeps what it publishes, a router passes it on, and another client's inbox
receives it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from unittest.mock import patch

from saccade.benchmarks.bus.measure import Plan, Receive, Send, frames
from saccade.benchmarks.bus.peer import run_pair
from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.topics import FRAME
from saccade.shared.bus.transport import ZenohBus, free_endpoint
from saccade.shared.config import Config
from saccade.shared.loop.process import Inbox

WORLD = "bench"
CONFIG = "config.json"


class Ours:
    """ZenohBus through a router, with shared memory (shm, the default) or without it."""

    modules = ("zenoh",)

    def __init__(self, name: str, shared_memory: bool) -> None:
        self.name = name
        self._shared_memory = shared_memory

    def run(self, plan: Plan, folder: Path) -> None:
        """Runs both ends and a router as in every run."""
        endpoint = free_endpoint("tcp/127.0.0.1:0")
        Config().with_values({"bus.endpoint": endpoint, "bus.world": WORLD}).save(folder / CONFIG)
        router = [sys.executable, "-m", "saccade.services.router", "--config", str(folder / CONFIG)]
        run_pair(self, plan, folder, endpoint, beside=router)

    @contextmanager
    def sender(self, address: str) -> Iterator[Send]:
        """Publishes frames, and keeps them for a reader that missed one."""
        outbox, frame = Outbox(), frames()[0]
        with closing(self._bus(address)) as bus:

            def send(payload: bytes) -> None:
                outbox.keep(FRAME, None, frame, payload)
                bus.publish(FRAME, None, payload)

            bus.answer((FRAME,), outbox.answer)
            yield send

    @contextmanager
    def receiver(self, address: str) -> Iterator[Receive]:
        """Takes frames out of the inbox on the main thread."""
        inbox = Inbox()
        with closing(self._bus(address)) as bus:
            bus.subscribe((FRAME,), inbox.put)

            def receive() -> bytes:
                item = inbox.get()
                assert item is not None  # because nobody stops this inbox
                return item[2]

            yield receive

    def _bus(self, endpoint: str) -> ZenohBus:
        with nullcontext() if self._shared_memory else _no_shared_memory():
            return ZenohBus(endpoint, world=WORLD)


@contextmanager
def _no_shared_memory() -> Iterator[None]:
    """Clients that are opened in this context do not use shared memory, even if the router does. A patch does it,
    because the bus itself needs no such switch."""
    import zenoh

    plain = zenoh.Config

    def config() -> zenoh.Config:
        made = plain()
        made.insert_json5("transport/shared_memory/enabled", "false")
        return made

    with patch.object(zenoh, "Config", config):
        yield
