"""The temporary folder of a viewer. A lock says that it is in use, so folders of viewers that were killed are found."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

if sys.platform != "win32":
    import fcntl

PREFIX = "saccade-viewer-"


class Home:
    """A new temporary folder at `path`, which exists until `close`.

    The folder is locked. The lock ends with this process, also if it is killed. Then the next viewer of the same user
    removes the folder.
    """

    def __init__(self) -> None:
        remove_stale()
        self._lock: int | None = None
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        while not self._locked():  # another viewer that starts now took it for a stale one
            self.path = Path(tempfile.mkdtemp(prefix=PREFIX))

    def close(self) -> None:
        """Removes the folder. May be called twice."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _locked(self) -> bool:
        """Locks the folder; whether it is ours."""
        if sys.platform == "win32":
            return True
        try:
            self._lock = _lock(self.path)
            if os.path.samestat(os.fstat(self._lock), os.stat(self.path)):
                return True
        except OSError:
            return False
        os.close(self._lock)
        return False


def remove_stale() -> None:
    """Removes the folders of this user's viewers whose process has ended without removing them."""
    if sys.platform == "win32":
        return
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # it is in use, is not a folder, or is gone already
            if path.lstat().st_uid == os.getuid():
                lock = _lock(path)
                try:
                    shutil.rmtree(path, ignore_errors=True)
                finally:
                    os.close(lock)


def _lock(path: Path) -> int:
    """An open file that locks the folder until it is closed. Raises OSError if another process has it."""
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(folder)
        raise
    return folder
