"""Keeps what a service has published lately, for services that were started again, came late, or were cut off for a
while."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import zstandard

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import Stamp

Since = tuple[str, int, int]  # run, episode, step

KEPT_BYTES = 384 * 1024 * 1024  # as they were published; more than the frames of the longest episode
MEMORY_BYTES = 192 * 1024 * 1024  # as they are held, compressed; an image of the simulator then has a fifth of its size
COMPRESSED_FROM_BYTES = 4096  # a smaller message is held as it is
LEVEL = -3  # zstd's; an image takes 0.4 ms
PAGE_BYTES = 32 * 1024 * 1024  # about the size of one answer


class Kept(NamedTuple):
    """A message as it was published, with the time of publication."""

    topic: Topic
    part: str | None
    payload: bytes
    at: Since
    published_ns: int


class _Held(NamedTuple):
    """A message that is kept, whose payload of `size` bytes may be compressed."""

    kept: Kept
    size: int

    def told(self) -> Kept:
        """The message as it was published."""
        payload = self.kept.payload
        if len(payload) == self.size:
            return self.kept
        return self.kept._replace(payload=zstandard.ZstdDecompressor().decompress(payload))


class Outbox:
    """Keeps the newest `limit_bytes` of what was published, and all latched messages of the newest episode.

    Large messages are held compressed, in at most `memory_bytes`. An outbox may be used by several threads.
    """

    def __init__(self, limit_bytes: int = KEPT_BYTES, memory_bytes: int = MEMORY_BYTES) -> None:
        self._limit, self._published = limit_bytes, 0
        self._memory, self._held = memory_bytes, 0
        self._kept: deque[_Held] = deque()
        self._lock = threading.Lock()

    def keep(self, topic: Topic, part: str | None, message: Message | Stamp, payload: bytes) -> None:
        """Keeps a message. It must be called before the message is published, so that a reader that misses the message
        can ask for it."""
        at = (message.run, message.episode, message.step)
        held = _Held(Kept(topic, part, _compressed(payload), at, time.time_ns()), len(payload))
        with self._lock:
            self._kept.append(held)
            self._count(held, 1)
            holding = []
            while self._kept and (self._published > self._limit or self._held > self._memory):
                old = self._kept.popleft()
                if old.kept.topic.latched and old.kept.at[:2] == at[:2]:
                    holding.append(old)
                else:
                    self._count(old, -1)
            self._kept.extendleft(reversed(holding))

    def _count(self, held: _Held, sign: int) -> None:
        self._published += sign * held.size
        self._held += sign * len(held.kept.payload)

    def answer(self, topics: Iterable[Topic], since: Since | None, limit_bytes: int) -> list[Kept]:
        """Returns what was published on these topics in the run of `since` (run, episode, step), from that step on,
        oldest first.

        The answer consists of whole steps, and of about `limit_bytes` in all. Without `since` it begins at the start of
        the newest episode.
        """
        names = {topic.name for topic in topics}
        with self._lock:
            chosen = [held for held in self._kept if held.kept.topic.name in names]
        if since is None:
            if not chosen:
                return []
            since = (*chosen[-1].kept.at[:2], 0)
        chosen = [held for held in chosen if held.kept.at[0] == since[0] and held.kept.at[1:] >= since[1:]]
        answer: list[Kept] = []
        size = 0
        for held in chosen:
            if size > limit_bytes and held.kept.at != answer[-1].at:
                break
            answer.append(held.told())
            size += held.size
        return answer


def _compressed(payload: bytes) -> bytes:
    """A payload as it is held. It has another length only if it is compressed."""
    if len(payload) < COMPRESSED_FROM_BYTES:
        return payload
    small = zstandard.ZstdCompressor(level=LEVEL).compress(payload)
    # A copy, because what zstandard returns holds on to as much memory as the payload.
    return bytes(memoryview(small)) if len(small) < len(payload) else payload
