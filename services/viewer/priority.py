"""Who looks on has what the agent leaves of the processors."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

NICEST = 19
# Linux may share out the processors among sessions first: then this is a whole session's niceness, and that of a
# process counts within its session alone.
SESSION = Path("/proc/self/autogroup")


def step_back() -> None:
    """This process, and what it starts, comes last."""
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError):  # not Linux, or not allowed
        os.nice(NICEST)
    if os.getsid(0) == os.getpid():  # not a terminal's, in which a user works
        step_back_session()


def step_back_session() -> None:
    """So does this process's session."""
    with suppress(OSError):
        SESSION.write_text(str(NICEST))
