"""How every contender is measured: with the same frames, at the same pace, on the same clock.

The one-way latency is the time between two moments. The sender notes the time right before it begins with a message,
and the receiver when it has the message. Both use the clock that all processes of a machine share.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from saccade.shared.bus.messages import Frame
from saccade.shared.bus.wire import decode, encode
from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import IMAGE_SIZE_PX

ENCODED, CODED = KINDS = ("bytes", "encode + decode")  # from wire bytes to a buffer with them; from Frame to Frame
RING = 8  # so many different images: with one image, its bytes would still be in a cache
PROBE = b"probe"  # sent until the receiver is known to receive
PROBE_S = 0.05
SETTLE_S = 0.2
READY = "ready"

Send = Callable[[bytes], object]  # sends wire bytes
Receive = Callable[[], Any]  # waits for the next message and gives a readable buffer of its bytes


@dataclass(frozen=True)
class Plan:
    """How much is measured: `messages` in each round, after `warmup` messages that do not count."""

    rounds: int = 6
    messages: int = 200
    warmup: int = 20
    period_s: float = 0.01  # between two messages, so that none waits behind another, as in lockstep

    @property
    def total(self) -> int:
        """The messages of a round."""
        return self.warmup + self.messages

    @property
    def limit_s(self) -> float:
        """A round that takes longer has failed, seconds."""
        return 30 + self.total * (self.period_s + 0.05)


def frames() -> list[Frame]:
    """RING camera images of noise. They are the same in every process."""
    rng = np.random.default_rng(0)
    size = (IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3)
    return [Frame(run="bench", episode=0, step=i, rgb=rng.integers(0, 256, size, dtype=np.uint8),
                  intrinsics_px=np.ones(4), world_from_camera=np.eye(4)) for i in range(RING)]


def send_all(plan: Plan, kind: str, send: Send, folder: Path) -> np.ndarray:
    """Sends the messages of a round. Returns the times at which each was begun, nanoseconds [plan.total]."""
    images = frames()
    payloads = [encode(image) for image in images]
    while not (folder / READY).exists():
        send(PROBE)
        time.sleep(PROBE_S)
    time.sleep(SETTLE_S)
    began = np.zeros(plan.total, np.int64)
    for i in range(plan.total):
        time.sleep(plan.period_s)
        began[i] = time.monotonic_ns()
        send(payloads[i % RING] if kind == ENCODED else encode(images[i % RING]))
    return began


def receive_all(plan: Plan, kind: str, receive: Receive, folder: Path) -> np.ndarray:
    """Receives the messages of a round. Returns the times at which each was there, nanoseconds [plan.total]. Raises
    SaccadeError if a message is not the one that was sent."""
    expected = [np.frombuffer(encode(image), np.uint8) for image in frames()]
    arrived = np.zeros(plan.total, np.int64)
    i = 0
    while i < plan.total:
        payload = receive()
        if len(payload) == len(PROBE):
            (folder / READY).touch()
            continue
        message = decode(Frame, payload) if kind == CODED else None
        arrived[i] = time.monotonic_ns()
        if not np.array_equal(np.frombuffer(payload, np.uint8), expected[i % RING]):
            raise SaccadeError(f"message {i} is not the one that was sent")
        del payload, message  # a view of shared memory would keep that memory in use
        i += 1
    return arrived


def within_one_process(plan: Plan, kind: str) -> np.ndarray:
    """Measures the two yardsticks at the same pace: a plain copy of a frame's wire bytes into existing memory, and
    encoding and decoding with no transport between them. Returns nanoseconds [plan.total]."""
    images = frames()
    sources = [np.frombuffer(encode(image), np.uint8) for image in images]
    target = np.empty_like(sources[0])
    taken = np.zeros(plan.total, np.int64)
    for i in range(plan.total):
        time.sleep(plan.period_s)
        start, message = time.monotonic_ns(), None
        if kind == ENCODED:
            np.copyto(target, sources[i % RING])
        else:
            message = decode(Frame, encode(images[i % RING]))
        taken[i] = time.monotonic_ns() - start
        del message
    return taken
