"""The state of the source with which something was made."""

from __future__ import annotations

import os
import subprocess

from saccade.shared.config import PACKAGE

WRITTEN = ("results", "docs")
BUILT_FROM = PACKAGE / "COMMIT"  # this file is in a wheel


def commit() -> str:
    """Returns the commit of the source, followed by "-dirty" if the source was changed since.

    Changes of results and documents do not count, because runs write them. A package that was built knows its own
    commit. If there is neither a built package nor a git repository, it is the value of SACCADE_COMMIT, or "unknown".
    """
    if BUILT_FROM.is_file():  # first, because the environment may lie in a checkout of another project
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
