"""Files from outside. Only regular files are opened, and only a limited number of bytes is read.

Reading a FIFO, a socket or a device could block for ever. A huge or deeply nested file would fill the memory before it
is refused.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from saccade.shared.errors import SaccadeError, told

MIB = 1024 * 1024
MAX_DEPTH = 64  # levels of lists and maps within one another
MAX_VALUES = 4_000_000  # in one file; so many take some hundred megabytes
MAX_KEY_PARTS = 32  # of a dotted key in TOML; the time to read it grows with the square of this
KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
         stat.S_IFBLK: "a device"}

_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")


def size_of(number: int) -> str:
    """Returns a number of bytes in words."""
    return f"{number // MIB} MiB" if number >= MIB else f"{number} bytes"


@contextmanager
def opened(path: Path, what: str, need: str, limit: int) -> Iterator[BinaryIO]:
    """Opens a regular file of at most `limit` bytes for reading. It never blocks.

    Raises SaccadeError, which begins with `what` and the path and ends with `need`. It does so also if reading fails
    within the context.
    """
    with _open(path, what, need, limit) as stream:
        try:
            yield stream
        except OSError as error:
            raise SaccadeError(f"{what} {path} cannot be read ({error.strerror or error}): {need}") from error


def _open(path: Path, what: str, need: str, limit: int) -> BinaryIO:
    try:
        _require_regular(os.stat(path), path, what, need)  # before opening, because opening a device may have an effect
        stream = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:  # ValueError: a path that no file can have
        raise SaccadeError(f"{what} {path} cannot be read ({getattr(error, 'strerror', error)}): {need}") from error
    try:
        found = os.fstat(stream.fileno())
        _require_regular(found, path, what, need)
        if found.st_size > limit:
            raise SaccadeError(f"{what} {path} is larger than {size_of(limit)}: {need}")
    except BaseException:
        stream.close()
        raise
    return stream


def _require_regular(found: os.stat_result, path: Path, what: str, need: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise SaccadeError(f"{what} {path} cannot be read (it is {kind}, not a file): {need}")


def read_bytes(path: Path, what: str, need: str, limit: int) -> bytes:
    """Returns the bytes of a file. Raises SaccadeError like `opened`."""
    with opened(path, what, need, limit) as stream:
        data = stream.read(limit + 1) or b""
    if len(data) > limit:  # it has grown, or it does not tell its size
        raise SaccadeError(f"{what} {path} is larger than {size_of(limit)}: {need}")
    return data


def read_text(path: Path, what: str, need: str, limit: int) -> str:
    """Returns the text of a file in UTF-8, with line feeds at the ends of its lines. Raises SaccadeError like `opened`,
    and if it is not UTF-8."""
    try:
        return read_bytes(path, what, need, limit).decode().replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise SaccadeError(f"{what} {path} is not a text in UTF-8 (byte {error.start}): {need}") from error


def parse_json(text: str, *, max_values: int = MAX_VALUES) -> Any:
    """Returns what a text in JSON holds. Raises ValueError if it is not JSON, is nested too deeply, holds too many
    values, or repeats a key."""
    if text.count(",") + text.count("[") + text.count("{") > max_values:
        raise ValueError(f"it holds more than {max_values} values")
    try:
        tree = json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels") from error
    _require_flat(tree)
    return tree


def parse_toml(text: str) -> dict[str, Any]:
    """Returns what a text in TOML holds. Raises ValueError if it is not TOML, is nested too deeply, or has a key of too
    many parts."""
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {MAX_KEY_PARTS} parts")
    try:
        tree = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels") from error
    _require_flat(tree)
    return tree


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, value in pairs:
        if key in tree:
            raise ValueError(f"key {told(key)} is there twice in one map")
        tree[key] = value
    return tree


def _require_flat(tree: Any) -> None:
    level = [tree]
    for _ in range(MAX_DEPTH):
        level = [child for node in level if isinstance(node, (dict, list))
                 for child in (node.values() if isinstance(node, dict) else node)]
        if not level:
            return
    raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")


@contextmanager
def writing(path: Path, what: str) -> Iterator[None]:
    """Is put around code that writes to `path`. Raises SaccadeError if that fails, for example because the disk is full
    or the folder is read-only."""
    try:
        yield
    except OSError as error:
        raise SaccadeError(f"{what} {path} cannot be written ({error.strerror or error}): {remedy(error)}") from error


def remedy(error: OSError) -> str:
    """What a user can do where something could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "free some space, or name another place"
    if error.errno in (errno.EACCES, errno.EPERM):
        return "give yourself the permission to write there, or name a place where you may write"
    if error.errno == errno.EROFS:
        return "name a place that is not read-only"
    return "name another place"


def append_line(path: Path, line: str) -> None:
    """Appends a line to a file, whole or not at all. Raises OSError if that fails."""
    with path.open("ab", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        rest = memoryview(f"{line}\n".encode())
        try:
            while rest:
                rest = rest[file.write(rest):]
        except OSError:
            with suppress(OSError):
                file.truncate(end)
            raise


def replace_whole(path: Path, data: bytes) -> None:
    """Writes a file. If that fails, the file stays as it was before. Raises OSError."""
    replace_all(path.parent, {path.name: data})


def write_json(path: Path, tree: Any, what: str) -> None:
    """Writes a tree as JSON, in place of what was there. Raises SaccadeError, which says `what` it is, if this
    fails."""
    with writing(path, what):
        replace_whole(path, (json.dumps(tree, indent=1) + "\n").encode())


def replace_all(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Writes several files of a folder. If one of them cannot be written, all stay as they were. Raises OSError."""
    drafts = {folder / name: folder / f"{name}.part" for name in contents}
    try:
        for draft, data in zip(drafts.values(), contents.values(), strict=True):
            draft.write_bytes(data)
        for path, draft in drafts.items():
            draft.replace(path)
    finally:
        for draft in drafts.values():
            with suppress(OSError):
                draft.unlink()
