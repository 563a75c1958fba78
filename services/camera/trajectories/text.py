"""Lines of numbers: texts that hold poses are read line by line, and a bad line is named with its number."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, read_text

MAX_FILE_BYTES, MAX_POSES, MAX_LINE = 64 * MIB, 500_000, 4096
NEED = "give JSON lines, TUM, KITTI, EuRoC, transforms.json, COLMAP, Record3D or Stray Scanner"

Line = tuple[int, str]  # its number from 1, and its text without blanks at the ends


@contextmanager
def within(path: Path, where: str) -> Iterator[None]:
    """Turns a ValueError into a SaccadeError that names the file and the place in it, such as `:12` or `, frame 3`."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise SaccadeError(f"poses {path}{where}: {error}") from error


def text_of(path: Path, what: str = "poses") -> str:
    """The text of a file in UTF-8, without a byte-order mark. Raises SaccadeError as `read_text` does."""
    return read_text(path, what, NEED, MAX_FILE_BYTES).removeprefix("\ufeff")


def lines_of(path: Path, text: str) -> list[Line]:
    """The lines that are neither blank nor comments. Raises SaccadeError if there are none, too many, or one that is
    too long."""
    numbered = enumerate(map(str.strip, io.StringIO(text)), start=1)
    lines = list(islice(((n, line) for n, line in numbered if line and not line.startswith("#")), MAX_POSES + 1))
    if not lines:
        raise SaccadeError(f"poses {path} holds no pose: {NEED}")
    if len(lines) > MAX_POSES:
        raise SaccadeError(f"poses {path} holds more than {MAX_POSES} poses: leave out what no image needs")
    if too_long := next((n for n, line in lines if len(line) > MAX_LINE), None):
        raise SaccadeError(f"poses {path}:{too_long}: a line of more than {MAX_LINE} characters: {NEED}")
    return lines


def words_of(line: str) -> list[str]:
    """The words of a line: between commas if it has any, else between blanks and tabs."""
    if "," not in line:
        return line.split()
    return [word.strip() for word in line.rstrip(", \t").split(",")]


def numbers_of(line: str) -> list[float]:
    """The numbers of a line. Raises ValueError if a word is not a number."""
    return [float(word) for word in words_of(line)]


def later(before: float | None, now: float) -> float:
    """The time `now` in seconds. Raises ValueError if it is not later than the one before it."""
    if before is not None and now <= before:
        how = "is there twice" if now == before else f"goes back, from {before:.6f} s"
        raise ValueError(f"the time {now:.6f} s {how}: sort the lines by time, and give each time once")
    return now
