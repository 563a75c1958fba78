"""Keeps what a service has published lately, for services that were started again, came late, or were cut off for a
while."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import Stamp

Since = tuple[str, int, int]  # run, episode, step

KEPT_BYTES = 384 * 1024 * 1024  # more than the frames of the longest episode
PAGE_BYTES = 32 * 1024 * 1024  # about the size of one answer


class Kept(NamedTuple):
    """A message as it was published, with the time of publication."""

    topic: Topic
    part: str | None
    payload: bytes
    at: Since
    published_ns: int


class Outbox:
    """Keeps the newest `limit_bytes` of what was published, and all latched messages of the newest episode. It may be
    used by several threads."""

    def __init__(self, limit_bytes: int = KEPT_BYTES) -> None:
        self._limit, self._held = limit_bytes, 0
        self._kept: deque[Kept] = deque()
        self._lock = threading.Lock()

    def keep(self, topic: Topic, part: str | None, message: Message | Stamp, payload: bytes) -> None:
        """Keeps a message. It must be called before the message is published, so that a reader that misses the message
        can ask for it."""
        kept = Kept(topic, part, payload, (message.run, message.episode, message.step), time.time_ns())
        with self._lock:
            self._kept.append(kept)
            self._held += len(payload)
            holding = []
            while self._held > self._limit and self._kept:
                old = self._kept.popleft()
                if old.topic.latched and old.at[:2] == kept.at[:2]:
                    holding.append(old)
                else:
                    self._held -= len(old.payload)
            self._kept.extendleft(reversed(holding))

    def answer(self, topics: Iterable[Topic], since: Since | None, limit_bytes: int) -> list[Kept]:
        """Returns what was published on these topics in the run of `since` (run, episode, step), from that step on,
        oldest first.

        The answer consists of whole steps, and of about `limit_bytes` in all. Without `since` it begins at the start of
        the newest episode.
        """
        names = {topic.name for topic in topics}
        with self._lock:
            chosen = [kept for kept in self._kept if kept.topic.name in names]
        if since is None:
            if not chosen:
                return []
            since = (*chosen[-1].at[:2], 0)
        chosen = [kept for kept in chosen if kept.at[0] == since[0] and kept.at[1:] >= since[1:]]
        answer: list[Kept] = []
        size = 0
        for kept in chosen:
            if size > limit_bytes and kept.at != answer[-1].at:
                break
            answer.append(kept)
            size += len(kept.payload)
        return answer
