"""Which state of the source something was made with."""

from __future__ import annotations

import subprocess

from shared.config import REPOSITORY


def commit() -> str:
    """The commit of the source, with "-dirty" where it was changed since; "unknown" outside a checkout."""
    command = ["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip() or "unknown"
