"""The one exception for what the user can mend: what, where, what to do, in one line."""

from __future__ import annotations


class SaccadeError(Exception):
    """Bad input or a missing piece of the machine. Printed as one line, exit code 2, never as a traceback."""
