"""Says when a source that goes by time publishes its next frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


class Ticker:
    """A tick every `period_s` seconds after `start`, without drift. Ticks that were missed during a delay are left
    out."""

    def __init__(self, period_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period_s, self._clock = period_s, clock
        self._next_s = math.inf

    def start(self) -> None:
        """Starts. The first tick comes one period from now."""
        self._next_s = self._clock() + self._period_s

    def stop(self) -> None:
        """Stops. There are no more ticks."""
        self._next_s = math.inf

    @property
    def wait_s(self) -> float:
        """Seconds until the next tick. Infinite before the start, and 0 if the tick is due."""
        return max(0.0, self._next_s - self._clock())

    def take(self) -> bool:
        """Returns whether a tick is due, and takes it if so."""
        late_s = self._clock() - self._next_s
        if late_s < 0.0:
            return False
        self._next_s += self._period_s * (1 + math.floor(late_s / self._period_s))
        return True
