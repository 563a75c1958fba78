"""Who looks on has what the agent leaves of the processors."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

LAST = 19  # niceness
# Linux may share out the processors among sessions first: then this is a whole session's niceness, and that of a
# process counts within its session alone.
SESSION = Path("/proc/self/autogroup")


def come_last() -> None:
    """This process, and what it starts, comes after all others."""
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError):  # not Linux, or not allowed
        os.nice(LAST)
    if os.getsid(0) == os.getpid():  # not a terminal's, in which a user works
        session_comes_last()


def session_comes_last() -> None:
    """So does this process's session."""
    with suppress(OSError):
        SESSION.write_text(str(LAST))
