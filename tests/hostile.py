"""What tests of hostile files share: what is no file, what is too large, a full disk, and limits on a process."""

from __future__ import annotations

import errno
import os
import resource
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from saccade.shared.errors import LINE_LIMIT, SaccadeError

MANY, BYTES, SECONDS = 100_000, 3 * 2 ** 30, 20


def complaint(action, *arguments, **options) -> str:
    """The one line in which it is refused."""
    with pytest.raises(SaccadeError) as caught:
        action(*arguments, **options)
    text = str(caught.value)
    assert text.isprintable()
    assert len(text) <= LINE_LIMIT + 5
    return text


def within_limits(code: str, *arguments: object) -> str:
    """What a program prints that may use BYTES of address space and SECONDS of processor time."""
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))

    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True,
                          preexec_fn=limit)
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout


def sparse(path: Path, size: int) -> Path:
    """A file that says it is large and takes no room."""
    with path.open("wb") as file:
        file.truncate(size)
    return path


def not_files(folder: Path, suffix: str = "") -> dict[str, Path]:
    """What is no regular file, and would block whoever opens it to read."""
    fifo, listening = folder / f"fifo{suffix}", folder / f"socket{suffix}"
    os.mkfifo(fifo)
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(listening))
    return {"a FIFO": fifo, "a socket": listening, "a device": Path("/dev/zero"), "a folder": folder}


def full_disk(*_arguments, **_options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
