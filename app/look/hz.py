"""`saccade hz` shows how often messages come, and how regularly."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from rich.console import Console
from rich.live import Live as Display
from rich.table import Table

from saccade.app.log.source import log_of
from saccade.app.look.listen import TICK_S, Live, Logged, Wanted, live, until_interrupted
from saccade.app.run.display import cell, say
from saccade.shared.bus.topics import Topic

WINDOW_S = 10.0
MOST = 10_000  # a window holds at most so many messages of one key
LINES_EVERY_S = 1.0
UNKNOWN = "-"


@dataclass
class Rate:
    """The messages of one key: `count` is the number of all, and `recent` holds the times (s) and sizes (bytes) of
    those in the window."""

    count: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=MOST))

    def values(self) -> tuple[int, float, float, float, float]:
        """Returns the count, and for the window: the rate (1/s), the mean interval (s), its standard deviation (s) and
        the bytes per second. These are NaN while the window does not hold two messages with different times."""
        times = sorted(at for at, _ in self.recent)  # in a log, messages that were asked for again come later
        span = times[-1] - times[0] if times else 0.0
        if span <= 0:
            return self.count, math.nan, math.nan, math.nan, math.nan
        intervals = len(times) - 1
        mean = span / intervals
        jitter = math.sqrt(sum((b - a - mean) ** 2 for a, b in pairwise(times)) / intervals)
        size = sum(size for _, size in self.recent) - self.recent[0][1]
        return self.count, intervals / span, mean, jitter, size / span


class Rates:
    """The rates of all keys over the last `window_s` seconds. It is safe between threads."""

    def __init__(self, window_s: float = math.inf, most: int | None = MOST) -> None:
        self.total, self._window_s, self._most = 0, window_s, most
        self._rates: dict[tuple[Topic, str | None], Rate] = {}
        self._lock = threading.Lock()

    def take(self, topic: Topic, part: str | None, size: int, at_s: float) -> None:
        """Counts one message of `size` bytes that came at the time `at_s`."""
        with self._lock:
            rate = self._rates.setdefault((topic, part), Rate(recent=deque(maxlen=self._most)))
            rate.count += 1
            rate.recent.append((at_s, size))
            self.total += 1

    def rows(self, world: str, now_s: float = -math.inf) -> list[tuple[str, ...]]:
        """Returns a row of texts for each key: key, count, rate, mean interval, jitter and bytes per second."""
        with self._lock:
            for rate in self._rates.values():
                while rate.recent and rate.recent[0][0] < now_s - self._window_s:
                    rate.recent.popleft()
            return sorted((topic.key(world, part), *_texts(rate.values()))
                          for (topic, part), rate in self._rates.items())


def hz(key: str, *, log: Path | None, count: int | None, endpoint: str | None, run: Path | None,
       console: Console | None = None) -> None:
    """Shows rates until Ctrl-C or until `count` messages have come, or the rates of a log. Raises SaccadeError if no
    message can come."""
    console, wanted = console or Console(), Wanted.parse(key)
    if log is None:
        with closing(live(wanted, endpoint=endpoint, run=run)) as source:
            follow(source, count, console)
        return
    logged, rates = Logged(wanted, log_of(log)), Rates(most=None)
    for heard in logged.heard():
        rates.take(heard.topic, heard.part, len(heard.payload), heard.time_ns / 1e9)
        if rates.total == count:
            break
    _tell(console, rates, logged.world)
    if logged.reader.cut:
        say(console, logged.reader.cut)


def follow(source: Live, count: int | None, console: Console) -> Rates:
    """Shows the rates of what comes on a bus. There is no queue here, so nothing is dropped."""
    rates, told_s = Rates(WINDOW_S), time.monotonic()
    source.listen(lambda topic, part, payload: rates.take(topic, part, len(payload), time.monotonic()))
    with until_interrupted(source.stop), Display(console=console, auto_refresh=False, transient=True) as display:
        while not source.inbox.stopping.wait(TICK_S) and (count is None or rates.total < count):
            now_s = time.monotonic()
            if console.is_terminal:
                display.update(_table(rates.rows(source.world, now_s)), refresh=True)
            elif now_s - told_s >= LINES_EVERY_S:
                told_s = now_s
                _tell(console, rates, source.world, now_s)
    _tell(console, rates, source.world, time.monotonic())
    return rates


def _tell(console: Console, rates: Rates, world: str, now_s: float = -math.inf) -> None:
    for line in _lines(rates.rows(world, now_s)):
        say(console, line)


def _lines(rows: list[tuple[str, ...]]) -> Iterator[str]:
    for key, count, rate, interval, jitter, size in rows:
        if rate == UNKNOWN:
            yield f"{key}: {count} message{'s' if count != '1' else ''}, too few for a rate"
        else:
            yield f"{key}: {count} messages, {rate} Hz, every {interval} ms ± {jitter} ms, {size} B/s"
    if not rows:
        yield "no messages"


def _table(rows: list[tuple[str, ...]]) -> Table:
    table = Table()
    for header in ("key", "messages", "Hz", "interval ms", "jitter ms", "bytes/s"):
        table.add_column(header, justify="left" if header == "key" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(cell, row))
    return table


def _texts(values: tuple[int, float, float, float, float]) -> tuple[str, ...]:
    count, rate, interval, jitter, size = values
    if math.isnan(rate):
        return (str(count), *(4 * [UNKNOWN]))
    return str(count), f"{rate:.2f}", f"{interval * 1e3:.1f}", f"{jitter * 1e3:.1f}", f"{size:,.0f}"
