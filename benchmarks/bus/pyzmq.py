"""pyzmq: PUB and SUB sockets over a Unix socket or loopback TCP, without copies in Python."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from saccade.benchmarks.bus.measure import Plan, Receive, Send
from saccade.benchmarks.bus.peer import run_pair
from saccade.shared.bus.transport import free_endpoint


class PyZmq:
    """One publisher that binds, and one subscriber that connects."""

    modules = ("zmq",)

    def __init__(self, name: str, scheme: str) -> None:
        self.name = name
        self._scheme = scheme

    def run(self, plan: Plan, folder: Path) -> None:
        """Runs both ends; no third process is between them."""
        address = f"ipc://{folder}/frames"
        if self._scheme == "tcp":
            address = free_endpoint("tcp/127.0.0.1:0").replace("/", "://", 1)
        run_pair(self, plan, folder, address)

    @contextmanager
    def sender(self, address: str) -> Iterator[Send]:
        """Publishes without a limit, so that nothing is dropped."""
        import zmq

        with zmq.Context() as context, context.socket(zmq.PUB) as socket:
            socket.set_hwm(0)
            socket.bind(address)
            yield lambda payload: socket.send(payload, copy=False)

    @contextmanager
    def receiver(self, address: str) -> Iterator[Receive]:
        """Gives views of the library's own buffers."""
        import zmq

        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.set_hwm(0)
            socket.connect(address)
            socket.subscribe(b"")
            yield lambda: socket.recv(copy=False).buffer
