"""Plays a log: selects its messages, times them, and lets the user pause."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import MessageError, Stamp, stamp_of
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import Recorded, RunReader

PAUSE, QUIT = " ", "q"
POLL_S = 0.02


@dataclass(frozen=True)
class Selection:
    """Which messages of a log are played.

    Steps are counted within each episode, and `end_step` is the last one that is played. Latched messages (the goal)
    are played even if they come before `start_step`.
    """

    topics: tuple[Topic, ...]
    episode: int | None = None
    start_step: int = 0
    end_step: int | None = None

    def __contains__(self, told: tuple[Topic, Stamp]) -> bool:
        topic, message = told
        return (topic in self.topics and self.episode in (None, message.episode)
                and (self.start_step <= message.step or topic.latched)
                and (self.end_step is None or message.step <= self.end_step))


def steps_between(log: Path, clock: Topic, start_s: float | None, end_s: float | None, *,
                  episode: int | None = None) -> tuple[int, int, int]:
    """The episode, the first and the last step of the messages of topic `clock` that were recorded between two times.

    Times are seconds from the start of the log. Raises SaccadeError if there is no such message, or if the messages
    belong to several episodes.
    """
    begin_ns, found = None, []
    for entry in RunReader(log).entries():
        begin_ns = entry.log_time_ns if begin_ns is None else begin_ns
        at_s = (entry.log_time_ns - begin_ns) / 1e9
        if entry.topic == clock and (start_s is None or at_s >= start_s) and (end_s is None or at_s <= end_s):
            with contextlib.suppress(MessageError):
                message = stamp_of(entry.payload)
                if episode in (None, message.episode):
                    found.append((message.episode, message.step))
    episodes = sorted({at[0] for at in found})
    if len(episodes) != 1:
        which = f"holds episodes {episodes[0]} to {episodes[-1]}: name one with --episode" if episodes else "is empty"
        raise SaccadeError(f"log {log}: the time asked for {which}")
    steps = [step for _, step in found]
    return episodes[0], min(steps), max(steps)


class Pace:
    """When the next message is due. Messages are played `rate` times as fast as recorded; None means without waiting.

    `late_s` is the largest delay so far, in seconds.
    """

    def __init__(self, rate: float | None = None) -> None:
        self.rate, self.late_s = rate, 0.0
        self._zero: tuple[int, float] | None = None

    def due_in_s(self, log_time_ns: int) -> float:
        """Seconds to wait until a message with this log time is due. Negative if playing is behind the clock."""
        if self.rate is None:
            return 0.0
        if self._zero is None:
            self._zero = (log_time_ns, time.monotonic())
        due_s = self._zero[1] + (log_time_ns - self._zero[0]) / 1e9 / self.rate
        wait_s = due_s - time.monotonic()
        self.late_s = max(self.late_s, -wait_s)
        return wait_s

    def paused(self, seconds: float) -> None:
        """Tells the clock that playing was paused for this time."""
        if self._zero is not None:
            self._zero = (self._zero[0], self._zero[1] + seconds)


class Keys:
    """Key presses on the standard input, which is a terminal or a pipe. It is a context manager.

    `ended` says that no more key presses will come.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.ended = not enabled
        self._before: list | None = None

    def __enter__(self) -> Self:
        if not self.ended and sys.stdin.isatty():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def pressed(self, wait_s: float = 0.0) -> str | None:
        """The next key that is pressed within `wait_s` seconds, or None."""
        if self.ended:
            if wait_s > 0:
                time.sleep(wait_s)
            return None
        if not select.select([sys.stdin], [], [], wait_s)[0]:
            return None
        key = os.read(sys.stdin.fileno(), 1).decode(errors="replace")
        self.ended = not key
        return key or None


def play(entries: Iterator[Recorded], selection: Selection, pace: Pace, keys: Keys, *, one_by_one: bool = False,
         may_go_on: Callable[[Stamp], bool] = lambda _stamp: True,
         say: Callable[[str], None] = lambda _text: None) -> Iterator[tuple[Recorded, Stamp]]:
    """Yields the selected messages when they are due.

    The space key pauses and continues, q ends. With `one_by_one` each key press gives one message. Playing waits while
    `may_go_on(stamp)` is false, for example because the receivers are too far behind. `say` gets texts for the user.
    """
    for entry in entries:
        try:
            stamp = stamp_of(entry.payload)
        except MessageError:
            continue
        if (entry.topic, stamp) not in selection:
            continue
        if one_by_one:
            while not keys.ended and (key := keys.pressed(POLL_S)) is None:
                pass
            if keys.ended or key == QUIT:
                return
        elif not _wait(pace, entry, keys, say):
            return
        while not may_go_on(stamp):
            time.sleep(POLL_S / 10)
        yield entry, stamp


def _wait(pace: Pace, entry: Recorded, keys: Keys, say: Callable[[str], None]) -> bool:
    """Waits until the entry is due. Returns False if the user has ended the replay."""
    paused = False
    while True:
        wait_s = pace.due_in_s(entry.log_time_ns)
        start_s = time.monotonic()
        key = keys.pressed(POLL_S if paused else min(max(wait_s, 0.0), POLL_S))
        if key == QUIT:
            return False
        if key == PAUSE:
            paused = not paused
            say("paused: press space to continue, q to end" if paused else "continues")
        if paused:
            pace.paused(time.monotonic() - start_s)
        elif wait_s <= 0:
            return True
