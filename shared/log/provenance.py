"""Which state of the source something was made with."""

from __future__ import annotations

import os
import subprocess

from saccade.shared.config import PACKAGE

WRITTEN = ("results", "docs")
BUILT_FROM = PACKAGE / "COMMIT"  # in a wheel


def commit() -> str:
    """The commit of the source, with "-dirty" where it was changed since. Results and documents may change: they are
    what runs write. A package that was built knows its own; elsewhere it is what SACCADE_COMMIT says, or "unknown"."""
    if BUILT_FROM.is_file():  # first: an environment may lie in a checkout of something else
        return BUILT_FROM.read_text().strip()
    try:
        head = _git("rev-parse", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", *(f":!{room}" for room in WRITTEN))
    except (OSError, subprocess.SubprocessError):
        return os.environ.get("SACCADE_COMMIT", "unknown")
    return head + "-dirty" * bool(changed)


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(PACKAGE), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
