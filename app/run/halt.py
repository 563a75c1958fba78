"""Notices that a run cannot go on: every service is alive, and all of them wait."""

from __future__ import annotations

import time

from saccade.app.run.supervisor import HUNG_S
from saccade.shared.bus.messages import Message, Status
from saccade.shared.bus.topics import Topic
from saccade.shared.loop.process import REFUSED

HALTED_S = 8.0  # the run has come to a halt if all services wait for so long and none takes a step
IDLE_STATES = ("ready", "finished", "not recording")


class Pulse:
    """Knows whether a run makes progress. In lockstep every service waits for another one now and then, but never all
    at once."""

    def __init__(self, names: set[str]) -> None:
        self._names = names
        self._last: dict[str, tuple[Status, float]] = {}  # of each service: its last status, and when it came
        self._moved_s = time.monotonic()

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes any message that the launcher hears."""
        now_s = time.monotonic()
        if not isinstance(message, Status):
            self._moved_s = now_s
        elif part in self._names:
            before = self._last.get(part)
            if before is None or _progress(before[0]) != _progress(message):
                self._moved_s = now_s
            self._last[part] = message, now_s

    def halted(self) -> str | None:
        """Says why the run cannot go on: what each service waits for, or what it says. None while the run makes
        progress."""
        now_s = time.monotonic()
        # A service that is silent hangs or is starting again: its supervisor handles it
        idle = [now_s - heard_s <= HUNG_S and status.state in IDLE_STATES for status, heard_s in self._last.values()]
        if not self._names or set(self._last) != self._names or not all(idle):
            self._moved_s = now_s
        if now_s - self._moved_s < HALTED_S:
            return None
        told = [(name, status) for name, (status, _) in sorted(self._last.items()) if status.note]
        reasons = [one for one in told if not one[1].note.startswith(REFUSED)]  # what was refused is seldom the reason
        notes = [f"{name} {status.note}" if status.state == "ready" else f"{name} is {status.state}: {status.note}"
                 for name, status in reasons or told]
        return f"the run came to a halt: {'; '.join(notes) or 'all services wait, and none says for what'}"


def _progress(status: Status) -> tuple[str, int, int]:
    return status.state, status.episode, status.step
