"""Every whole record of a log, however it was cut or damaged: what is broken is passed over and told."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import DAMAGE, MAX_RECORD_BYTES

HEAD = struct.Struct("<BQ")  # of every record: opcode and length
BROKEN = (*DAMAGE, RuntimeError)  # the last is what lz4 raises
TYPES: dict[int, Any] = {
    opcode: getattr(mcap, "".join(word.title() for word in opcode.name.split("_"))) for opcode in Opcode}
# where reading may start again: a record of one of these kinds, shorter than a terabyte
ANCHOR = re.compile(rb"(?=[%b](?s:.{5})\x00\x00\x00)" % bytes((
    Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END)))
WINDOW = 4 * 1024 * 1024  # bytes that are searched at a time


@dataclass
class Skipped:
    """A stretch of a log that could not be read. `messages`: how many it held, where the file still says so."""

    offset: int
    size: int
    reason: str
    messages: int = 0


class Salvage:
    """Reads a log's records in the order of the file, those of a chunk only if the whole chunk is as it was written.

    Once `records` is through: `skipped` are the stretches passed over; `after_cut` counts the bytes at the end that
    are no whole record, `ended` is whether the recording was finished. Raises SaccadeError for what is no file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.skipped: list[Skipped] = []
        self.after_cut, self.ended, self._size = 0, False, 0
        if path.exists() and not path.is_file():
            raise SaccadeError(f"log {path} is not a file")

    def records(self) -> Iterator[mcap.McapRecord]:
        """Schemas, channels, messages, metadata and attachments. Raises SaccadeError if the file cannot be read."""
        try:
            with self.path.open("rb") as stream:
                self._size = os.fstat(stream.fileno()).st_size
                yield from self._summary(stream)
                yield from self._data(stream)
        except OSError as error:
            raise SaccadeError(f"log {self.path} cannot be read: {error.strerror or error}") from error

    def _data(self, stream: BinaryIO) -> Iterator[mcap.McapRecord]:
        self.skipped, self.after_cut, self.ended = [], 0, False
        offset, damaged = len(MCAP0_MAGIC), None
        while offset < self._size and not self.ended:
            opcode, end = self._head(stream, offset)
            try:
                if end is None:
                    raise ValueError("no record")
                record = self._parse(stream, offset, opcode, end)
                if isinstance(record, mcap.Chunk):
                    damaged = None
                    yield from _opened(record)
                elif isinstance(record, mcap.DataEnd | mcap.Footer):
                    self.ended = True
                elif isinstance(record, mcap.MessageIndex):  # those of a chunk follow it
                    if damaged is not None:
                        damaged.messages += len(record.records)
                else:
                    yield record
            except BROKEN as error:
                framed = end is not None and (end == self._size or self._head(stream, end)[1] is not None)
                end = end if framed else self._next_anchor(stream, offset + 1)
                if end is None:
                    self.after_cut = self._size - offset
                    return
                what = TYPES[opcode].__name__ if framed else "record"
                damaged = Skipped(offset, end - offset, f"damaged {what.lower()} ({type(error).__name__})")
                self.skipped.append(damaged)
            offset = end

    def _head(self, stream: BinaryIO, offset: int) -> tuple[int, int | None]:
        """The opcode at an offset and where its record ends; None where none can be."""
        stream.seek(offset)
        head = stream.read(HEAD.size)
        if len(head) < HEAD.size:
            return 0, None
        opcode, length = HEAD.unpack(head)
        end = offset + HEAD.size + length
        return opcode, end if opcode in TYPES and length <= MAX_RECORD_BYTES and end <= self._size else None

    def _parse(self, stream: BinaryIO, offset: int, opcode: int, end: int) -> mcap.McapRecord:
        stream.seek(offset + HEAD.size)
        body = stream.read(end - offset - HEAD.size)
        reader = ReadDataStream(BytesIO(body))
        record = mcap.Message.read(reader, len(body)) if opcode == Opcode.MESSAGE else TYPES[opcode].read(reader)
        if reader.count != len(body):
            raise ValueError("its length is not that of its content")
        if isinstance(record, mcap.Attachment) and zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little") != 0:
            raise ValueError("its checksum is not that of its content")
        return record

    def _next_anchor(self, stream: BinaryIO, start: int) -> int | None:
        """Where the next record lies that is whole and followed by another or by the end."""
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
        try:
            record = self._parse(stream, offset, opcode, end)
        except BROKEN:
            return False
        return not isinstance(record, mcap.Metadata) or bool(record.name)  # in zeros there are many without a name

    def _summary(self, stream: BinaryIO) -> Iterator[mcap.McapRecord]:
        """The schemas and channels that a finished log repeats at its end, in case their chunk is damaged."""
        end = self._size - len(MCAP0_MAGIC)
        start = end - HEAD.size - 20
        opcode, stop = self._head(stream, start) if start > 0 else (0, None)
        if opcode != Opcode.FOOTER or stop != end:
            return
        footer = self._parse(stream, start, opcode, end)
        if not isinstance(footer, mcap.Footer):
            return
        if not 0 < footer.summary_start < start or start - footer.summary_start > MAX_RECORD_BYTES:
            return
        stream.seek(footer.summary_start)
        text = stream.read(end - 4 - footer.summary_start)
        if zlib.crc32(text) != footer.summary_crc:
            return
        offset = footer.summary_start
        while offset < start:
            opcode, stop = self._head(stream, offset)
            if stop is None:
                return
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield self._parse(stream, offset, opcode, stop)
            offset = stop


def _opened(chunk: mcap.Chunk) -> list[mcap.McapRecord]:
    """The records in a chunk. Raises one of BROKEN if it is not whole."""
    sizes = [chunk.uncompressed_size]
    if chunk.compression == "zstd":
        sizes.append(zstandard.frame_content_size(chunk.data))
    if max(sizes) > MAX_RECORD_BYTES:
        raise ValueError("its size cannot be")
    return breakup_chunk(chunk, validate_crc=True)
