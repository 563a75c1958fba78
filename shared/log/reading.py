"""Reading the log of a run, whole or not, of today's format or an older one."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic, parse_key
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.migrations import OLDEST, Migration
from saccade.shared.log.recording import CONFIGURATION, ENDED_EARLY, LOG

MAX_RECORD_BYTES = 512 * 1024 * 1024
DAMAGE = (McapError, struct.error, ZstdError, ValueError, OverflowError, MemoryError)


class Recorded(NamedTuple):
    """One entry of a log."""

    topic: Topic
    part: str | None
    payload: bytes
    log_time_ns: int


class RunReader:
    """Reads a log in the order of arrival, its messages as those of today's format. `cut` says, once it is read, why it
    ends before its end (None: it is whole); `refused` counts entries that are no valid messages; metadata and
    configuration are there before the first entry. Raises SaccadeError for a file that is no log, or one of a format to
    come. Without `sums` the checksums are not verified: twice as fast.
    """

    def __init__(self, path: Path, *, sums: bool = True) -> None:
        self.path, self.world, self._sums = path, "", sums
        self.cut: str | None = None
        self.refused = 0
        self.metadata: dict[str, dict[str, str]] = {}
        self.configuration: str | None = None
        try:
            with path.open("rb") as stream:
                head = stream.read(len(MCAP0_MAGIC))
        except OSError as error:
            raise SaccadeError(f"log {path} cannot be read: {error.strerror}") from error
        if head != MCAP0_MAGIC:
            kind = "empty: nothing was recorded" if not head else "not an MCAP file"
            raise SaccadeError(f"log {path} is {kind}")

    def __iter__(self) -> Iterator[tuple[Topic, str | None, Message]]:
        """Every valid message."""
        for entry in self.entries():
            try:
                yield entry.topic, entry.part, decode(entry.topic.type, entry.payload)
            except MessageError:
                self.refused += 1

    def entries(self) -> Iterator[Recorded]:
        """Every entry, valid or not."""
        channels: dict[int, tuple[Topic, str | None]] = {}
        migrate = None
        self.cut, self.refused = None, 0
        with self.path.open("rb") as stream:
            try:
                reader = StreamReader(stream, validate_crcs=self._sums, record_size_limit=MAX_RECORD_BYTES)
                for record in reader.records:
                    if isinstance(record, Channel):
                        with contextlib.suppress(SaccadeError):  # a channel that someone else added
                            self.world, topic, part = parse_key(record.topic)
                            channels[record.id] = topic, part
                    elif isinstance(record, McapMessage) and record.channel_id in channels:
                        migrate = migrate or Migration(self.format, self.path)
                        topic, part = channels[record.channel_id]
                        yield Recorded(topic, part, migrate(topic, part, record.data), record.log_time)
                    elif isinstance(record, Attachment) and record.name == CONFIGURATION:
                        self.configuration = record.data.decode()
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = dict(record.metadata)
            except DAMAGE as error:
                self.cut = f"log {self.path} is cut or damaged ({type(error).__name__}); it is read up to there"
        if self.cut is None and ENDED_EARLY in self.metadata:
            self.cut = f"log {self.path} ended early: {self.metadata[ENDED_EARLY].get('reason', '')}"

    @property
    def format(self) -> int:
        """The format that the log was written in; known once its first entry has been read. Raises SaccadeError where
        it is no number."""
        told = self.metadata.get(LOG, {}).get("format", str(OLDEST))
        if not (told.isascii() and told.isdigit() and len(told) < 10):
            raise SaccadeError(f"log {self.path} says that its format is {told!r}, which is no number")
        return int(told)
