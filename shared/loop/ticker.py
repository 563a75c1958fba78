"""When a source that goes by time publishes next."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


class Ticker:
    """A tick every `period_s` seconds after `start`, without drift; those that a stall has missed are left out."""

    def __init__(self, period_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period_s, self._clock = period_s, clock
        self._next_s = math.inf

    def start(self) -> None:
        """The first tick is one period from now."""
        self._next_s = self._clock() + self._period_s

    def stop(self) -> None:
        """No more ticks."""
        self._next_s = math.inf

    @property
    def wait_s(self) -> float:
        """Seconds to the next tick: infinite before the start, 0 when it is due."""
        return max(0.0, self._next_s - self._clock())

    def take(self) -> bool:
        """Whether a tick is due; if so it is taken."""
        late_s = self._clock() - self._next_s
        if late_s < 0.0:
            return False
        self._next_s += self._period_s * (1 + math.floor(late_s / self._period_s))
        return True
