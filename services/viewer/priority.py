"""Gives onlookers, such as the viewer, the lowest priority, so that they cannot slow the agent down."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

LAST = 19  # the lowest priority, as niceness
# Linux may share the processors among sessions first. The niceness of a session is then set in this file, and the
# niceness of a process counts only within its session.
SESSION = Path("/proc/self/autogroup")


def come_last() -> None:
    """Gives this process, and those that it starts, the lowest priority."""
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError):  # not Linux, or not allowed
        os.nice(LAST)
    if os.getsid(0) == os.getpid():  # the session is this process's own, not that of a user's terminal
        session_comes_last()


def session_comes_last() -> None:
    """Gives the session of this process the lowest priority, if Linux allows it."""
    with suppress(OSError):
        SESSION.write_text(str(LAST))
