"""Reads the records of an MCAP file one by one.

Whatever a file claims, the limits below bound the memory that is used. The time is bounded by what the file and its
chunks really hold.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO

import zstandard
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from saccade.shared.bus.wire import MAX_BYTES

MAX_CHUNK_BYTES = 4 * MAX_BYTES  # largest size of a chunk after it is decompressed
MAX_RECORD_BYTES = 256 * 1024 * 1024
MAX_ATTACHMENT_BYTES = 64 * 1024 * 1024
MAX_NOTE_BYTES = 1024 * 1024  # largest record that becomes many small objects, such as metadata and channels
# A chunk may hold MOST_TIMES its compressed size. Those that hold more may hold MOST_OPENED_BYTES together.
MOST_OPENED_BYTES, MOST_TIMES = 1024 ** 3, 500

HEAD = struct.Struct("<BQ")  # head of every record: opcode and length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, time of logging and of publication
FOOTER_BYTES = HEAD.size + 20
DAMAGE = (McapError, struct.error, zstandard.ZstdError, ValueError, OverflowError, MemoryError, RuntimeError)
# lz4 raises RuntimeError

TYPES: dict[int, Any] = {
    opcode: getattr(mcap, "".join(word.title() for word in opcode.name.split("_"))) for opcode in Opcode}
LARGE = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX)
WANTED = (Opcode.HEADER, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA)


def limit_of(opcode: int) -> int:
    """The largest size of a record of this kind, in bytes."""
    if opcode == Opcode.ATTACHMENT:
        return MAX_ATTACHMENT_BYTES
    return MAX_RECORD_BYTES if opcode in LARGE or opcode not in TYPES else MAX_NOTE_BYTES


def parse(opcode: int, body: bytes, *, exact: bool = False) -> Any:
    """Returns the record with this content. Raises one of DAMAGE if the content is not such a record, and with `exact`
    also if it is longer than the fields of the record."""
    if opcode == Opcode.MESSAGE:
        return _message(body, 0, len(body))
    reader = ReadDataStream(BytesIO(body))
    record = TYPES[opcode].read(reader)
    if exact and reader.count != len(body):
        raise ValueError("its length is not that of its content")
    return record


def _message(data: bytes, start: int, end: int) -> mcap.Message:
    if end - start < MESSAGE_HEAD.size:
        raise ValueError("a message is too short")
    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, start)
    return mcap.Message(channel_id=channel, log_time=log_time, data=data[start + MESSAGE_HEAD.size:end],
                        publish_time=publish_time, sequence=sequence)


class Opener:
    """Opens the chunks of one file. It stops if they become larger than a log can be."""

    def __init__(self, *, sums: bool) -> None:
        self._sums, self._swollen = sums, 0

    def data(self, chunk: mcap.Chunk) -> bytes:
        """Returns the data of a chunk. Raises one of DAMAGE if the chunk is not whole, or too large."""
        size = chunk.uncompressed_size
        if size > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk would open to {size} bytes")
        swollen = size if size > MOST_TIMES * len(chunk.data) else 0
        self._swollen += swollen
        if swollen and self._swollen > MOST_OPENED_BYTES:
            raise ValueError(f"a chunk would open to {size} bytes")
        data = _decompressed(chunk, size)
        if len(data) != size:
            raise ValueError("a chunk has another size than it says")
        if self._sums and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise ValueError("a chunk's checksum is not that of its content")
        return data


def _decompressed(chunk: mcap.Chunk, size: int) -> bytes:
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (-1, size):  # -1: it does not say
            raise ValueError("a chunk has another size than it says")
        return zstandard.decompress(chunk.data, size) if size else b""
    if chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # it says nothing of its types

        return LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    if chunk.compression:
        raise ValueError("a chunk is compressed in a way that is not known")
    return chunk.data


def within(data: bytes, kinds: tuple[int, ...] = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)) -> Iterator[Any]:
    """Yields the records of these kinds in the data of a chunk. Raises one of DAMAGE if a record is not whole."""
    offset, size = 0, len(data)
    while offset < size:
        opcode, length = HEAD.unpack_from(data, offset)
        start, offset = offset + HEAD.size, offset + HEAD.size + length
        if offset > size:
            raise EndOfFile()
        if opcode not in kinds:
            continue
        if opcode == Opcode.MESSAGE:
            yield _message(data, start, offset)
        elif length > MAX_NOTE_BYTES:
            raise ValueError("a record is too large")
        else:
            yield parse(opcode, data[start:offset])


def records(stream: BinaryIO, *, sums: bool = True, schemas: bool = False) -> Iterator[Any]:
    """Yields the header, channels, messages, metadata and attachments of a file, in the order of the file, including
    those in chunks, and with `schemas` also these. Raises one of DAMAGE where the file is cut or damaged."""
    more = (Opcode.SCHEMA,) if schemas else ()
    opener, size = Opener(sums=sums), os.fstat(stream.fileno()).st_size
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise ValueError("no MCAP file")
    opcode = 0
    while opcode != Opcode.FOOTER:
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        if opcode == 0 or length > limit_of(opcode):
            raise ValueError("a record that cannot be")
        if stream.tell() + length > size:
            raise EndOfFile()
        if opcode == Opcode.CHUNK:
            yield from within(opener.data(parse(opcode, stream.read(length))), (Opcode.CHANNEL, Opcode.MESSAGE, *more))
        elif opcode == Opcode.MESSAGE or opcode in WANTED or opcode in more:
            body = stream.read(length)
            if sums and opcode == Opcode.ATTACHMENT:
                check_attachment(body)
            yield parse(opcode, body)
        else:
            stream.seek(length, os.SEEK_CUR)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise EndOfFile()


def check_attachment(body: bytes) -> None:
    """Raises ValueError if the checksum of an attachment does not fit its content."""
    if zlib.crc32(memoryview(body)[:-4]) != int.from_bytes(body[-4:], "little") != 0:
        raise ValueError("its checksum is not that of its content")


def summary_of(stream: BinaryIO) -> bytes | None:
    """Returns the summary at the end of a finished file, without the footer. Returns None if there is no summary, or if
    it is not as it was written."""
    size = os.fstat(stream.fileno()).st_size
    end = size - len(MCAP0_MAGIC)
    start = end - FOOTER_BYTES
    if start < len(MCAP0_MAGIC):
        return None
    stream.seek(start)
    tail = stream.read(size - start)
    if HEAD.unpack_from(tail) != (Opcode.FOOTER, 20) or tail[FOOTER_BYTES:] != MCAP0_MAGIC:
        return None
    footer = parse(Opcode.FOOTER, tail[HEAD.size:FOOTER_BYTES])
    if not 0 < footer.summary_start < start or start - footer.summary_start > MAX_RECORD_BYTES:
        return None
    stream.seek(footer.summary_start)
    text = stream.read(end - 4 - footer.summary_start)
    return text[:start - footer.summary_start] if zlib.crc32(text) == footer.summary_crc else None
