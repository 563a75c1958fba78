"""What processes elsewhere are given to do; they find it by its name."""

from __future__ import annotations

import os
import time

from saccade.shared.errors import SaccadeError


def square(k: int) -> tuple[int, str]:
    return k * k, os.environ["OMP_NUM_THREADS"]


def slow(k: int) -> int:
    time.sleep(0.3)
    return os.getpid()


def fails(k: int) -> int:
    raise SaccadeError(f"no {k}")
