"""Reads every whole record of a log that was cut or damaged. Broken parts are passed over and reported."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records as mcap
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from saccade.shared.errors import SaccadeError
from saccade.shared.log.records import (
    DAMAGE,
    HEAD,
    TYPES,
    Opener,
    check_attachment,
    limit_of,
    parse,
    summary_of,
    within,
)

# Reading may start again at a record of one of these kinds that is shorter than a terabyte.
ANCHOR = re.compile(rb"(?=[%b](?s:.{5})\x00\x00\x00)" % bytes((
    Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END)))
WINDOW = 4 * 1024 * 1024  # bytes that are searched at a time
SEARCH_BYTES = 4 * 1024 ** 3  # searched in all for places where reading may start again
MOST_SKIPPED = 1000  # stretches that are listed one by one
INDEX_ENTRY_BYTES, INDEX_HEAD_BYTES = 16, 6  # sizes in a chunk's index of messages


@dataclass
class Skipped:
    """A stretch of a log that could not be read. `offset` and `size` are in bytes. `messages` is the number of messages
    that it held, if the file still says so."""

    offset: int
    size: int
    reason: str
    messages: int = 0


class Salvage:
    """Reads the records of a log in the order of the file. The records of a chunk are read only if the whole chunk is
    undamaged.

    When `records` has ended, `skipped` holds the stretches that were passed over, `after_cut` is the number of bytes at
    the end that form no whole record, and `ended` says whether the recording was finished. Raises SaccadeError if
    `path` is not a file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.skipped: list[Skipped] = []
        self.after_cut, self.ended, self._size, self._looked_at = 0, False, 0, 0
        if path.exists() and not path.is_file():
            raise SaccadeError(f"log {path} is not a file")

    def records(self) -> Iterator[mcap.McapRecord]:
        """Yields schemas, channels, messages, metadata and attachments. Raises SaccadeError if the file cannot be
        read."""
        try:
            with self.path.open("rb") as stream:
                self._size = os.fstat(stream.fileno()).st_size
                yield from self._summary(stream)
                yield from self._data(stream)
        except OSError as error:
            raise SaccadeError(f"log {self.path} cannot be read: {error.strerror or error}") from error

    def _data(self, stream: BinaryIO) -> Iterator[mcap.McapRecord]:
        self.skipped, self.after_cut, self.ended, self._looked_at = [], 0, False, 0
        offset, damaged, opener = len(MCAP0_MAGIC), None, Opener(sums=True)
        while offset < self._size and not self.ended:
            opcode, end = self._head(stream, offset)
            try:
                if end is None:
                    raise ValueError("no record")
                if opcode == Opcode.MESSAGE_INDEX:  # the indexes of a chunk follow it
                    held = self._indexed(stream, offset, end)
                    if damaged is not None:
                        damaged.messages += held
                elif opcode == Opcode.CHUNK:
                    data = opener.data(self._parse(stream, offset, opcode, end))
                    for _ in within(data):  # first, all records of the chunk must be whole
                        pass
                    damaged = None
                    yield from within(data)
                elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    self.ended = True
                else:
                    yield self._parse(stream, offset, opcode, end)
            except DAMAGE as error:
                framed = end is not None and (end == self._size or self._head(stream, end)[1] is not None)
                end = end if framed else self._next_anchor(stream, offset + 1)
                if end is None:
                    self.after_cut = self._size - offset
                    return
                what = TYPES[opcode].__name__ if framed else "record"
                damaged = self._skip(offset, end, f"damaged {what.lower()} ({type(error).__name__})")
            offset = end

    def _skip(self, offset: int, end: int, reason: str) -> Skipped:
        """Notes a stretch. It is joined with the stretch before if it follows directly for the same reason, or if there
        are too many."""
        last = self.skipped[-1] if self.skipped else None
        if last is not None and ((last.reason == reason and last.offset + last.size == offset and not last.messages)
                                 or len(self.skipped) >= MOST_SKIPPED):
            last.size = end - last.offset
            return last
        self.skipped.append(Skipped(offset, end - offset, reason))
        return self.skipped[-1]

    def _head(self, stream: BinaryIO, offset: int) -> tuple[int, int | None]:
        """Returns the opcode at an offset and the end of its record. The end is None if no record can be there."""
        stream.seek(offset)
        head = stream.read(HEAD.size)
        if len(head) < HEAD.size:
            return 0, None
        opcode, length = HEAD.unpack(head)
        end = offset + HEAD.size + length
        return opcode, end if opcode in TYPES and length <= limit_of(opcode) and end <= self._size else None

    def _parse(self, stream: BinaryIO, offset: int, opcode: int, end: int) -> Any:
        stream.seek(offset + HEAD.size)
        body = stream.read(end - offset - HEAD.size)
        record = parse(opcode, body, exact=True)
        if opcode == Opcode.ATTACHMENT:
            check_attachment(body)
        return record

    def _indexed(self, stream: BinaryIO, offset: int, end: int) -> int:
        """Returns how many messages an index of messages names. The index may be long, so its entries are not read."""
        stream.seek(offset + HEAD.size + 2)
        size = int.from_bytes(stream.read(4), "little")
        if size != end - offset - HEAD.size - INDEX_HEAD_BYTES or size % INDEX_ENTRY_BYTES:
            raise ValueError("its length is not that of its content")
        return size // INDEX_ENTRY_BYTES

    def _next_anchor(self, stream: BinaryIO, start: int) -> int | None:
        """Returns where the next whole record lies that is followed by another record or by the end of the file."""
        for window in range(start, self._size, WINDOW):
            stream.seek(window)
            for match in ANCHOR.finditer(stream.read(WINDOW + HEAD.size - 1)):
                if match.start() < WINDOW and self._is_anchor(stream, window + match.start()):
                    return window + match.start()
        return None

    def _is_anchor(self, stream: BinaryIO, offset: int) -> bool:
        opcode, end = self._head(stream, offset)
        if end is None or (end != self._size and self._head(stream, end)[1] is None):
            return False
        self._looked_at += end - offset
        if self._looked_at > SEARCH_BYTES:  # a file with so many beginnings was made to have them
            return False
        try:
            if opcode == Opcode.MESSAGE_INDEX:
                return self._indexed(stream, offset, end) > 0
            record = self._parse(stream, offset, opcode, end)
        except DAMAGE:
            return False
        return not isinstance(record, mcap.Metadata) or bool(record.name)  # zeros look like many without a name

    def _summary(self, stream: BinaryIO) -> Iterator[mcap.McapRecord]:
        """Yields the schemas and channels that a finished log repeats at its end, in case their chunk is damaged."""
        text = summary_of(stream)
        if text is not None:
            yield from within(text, (Opcode.SCHEMA, Opcode.CHANNEL))
