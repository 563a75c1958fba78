"""Reads the log of a run, whole or damaged, in the present format or an older one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.writer import MCAP0_MAGIC

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic, parse_key
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import SaccadeError, printable
from saccade.shared.files import opened
from saccade.shared.log.foreign import foreign, is_ours
from saccade.shared.log.migrations import OLDEST, Migration
from saccade.shared.log.recording import CONFIGURATION, ENDED_EARLY, KEY, LOG
from saccade.shared.log.records import DAMAGE, records, summary_of

NEED = "give the run.mcap of a run"
ANY_SIZE = 2 ** 63
MOST_NOTES = 1000  # metadata records; a log of Saccade's has a few
MAX_CONFIGURATION_BYTES = 4 * 1024 * 1024


class Recorded(NamedTuple):
    """One entry of a log."""

    topic: Topic
    part: str | None
    payload: bytes
    log_time_ns: int


class RunReader:
    """Reads a log in the order of arrival. Its messages come in the present format.

    When the log has been read, `cut` says why it ends early; it is None if the log is whole. `refused` counts entries
    that are not valid messages, and `others` counts entries under keys that are not Saccade's. Metadata and
    configuration are known before the first entry. Without `sums` the checksums are not verified, which is twice as
    fast. Raises SaccadeError if the file is not a log, or if its format is newer than this Saccade.
    """

    def __init__(self, path: Path, *, sums: bool = True) -> None:
        self.path, self.world, self._sums = path, "", sums
        self.cut: str | None = None
        self.refused = self.others = 0
        self.metadata: dict[str, dict[str, str]] = {}
        self.configuration: str | None = None
        with opened(path, "log", NEED, ANY_SIZE) as stream:
            head = stream.read(len(MCAP0_MAGIC))
            if head != MCAP0_MAGIC:
                kind = "empty: nothing was recorded" if not head else f"not an MCAP file: {NEED}"
                raise SaccadeError(f"log {path} is {kind}")
            if (other := foreign(path)) is not None:
                raise SaccadeError(other)

    def __iter__(self) -> Iterator[tuple[Topic, str | None, Message]]:
        """Yields every valid message with its topic and part."""
        for entry in self.entries():
            try:
                yield entry.topic, entry.part, decode(entry.topic.type, entry.payload)
            except MessageError:
                self.refused += 1

    def entries(self) -> Iterator[Recorded]:
        """Yields every entry, valid or not."""
        channels: dict[int, tuple[Topic, str | None]] = {}
        migrate = None
        self.cut, self.refused, self.others = None, 0, 0
        with self.path.open("rb") as stream:
            try:
                for record in records(stream, sums=self._sums):
                    if isinstance(record, McapMessage):
                        if record.channel_id not in channels:
                            self.others += 1
                            continue
                        migrate = migrate or Migration(self.format, self.path)
                        topic, part = channels[record.channel_id]
                        yield Recorded(topic, part, migrate(topic, part, record.data), record.log_time)
                    elif isinstance(record, Channel):
                        channels.pop(record.id, None)
                        if is_ours(record):  # other channels were added by somebody else
                            self.world, topic, part = parse_key(record.topic)
                            channels[record.id] = topic, part
                    else:
                        self._note(record)
            except DAMAGE as error:
                self.cut = f"log {self.path} is cut or damaged ({type(error).__name__}); it is read up to there"
        if self.cut is None and ENDED_EARLY in self.metadata:
            reason = printable(self.metadata[ENDED_EARLY].get("reason", ""))
            self.cut = f"log {self.path} ended early: {reason}"

    def _note(self, record: object) -> None:
        """Takes a record that is not a message. Raises ValueError if there are more of them than a log has."""
        if isinstance(record, Attachment) and record.name == CONFIGURATION:
            if len(record.data) > MAX_CONFIGURATION_BYTES:
                raise ValueError("the configuration is too large")
            self.configuration = record.data.decode(errors="replace")  # `recorded` refuses damaged text
        elif isinstance(record, Metadata) and record.name != KEY:
            if len(self.metadata) >= MOST_NOTES and record.name not in self.metadata:
                raise ValueError("there is too much metadata")
            self.metadata[record.name] = dict(record.metadata)

    def require_something(self) -> None:
        """Raises SaccadeError if the log is damaged from its start on. It is called when the log has been read."""
        if self.cut is not None and not self.metadata:
            raise SaccadeError(f"{self.path} holds nothing that can be read: it is damaged from its start on; "
                               "`saccade log recover` looks for what is left")

    @property
    def format(self) -> int:
        """The format in which the log was written. It is known when the first entry has been read. Raises SaccadeError
        if it is not a number."""
        told = self.metadata.get(LOG, {}).get("format", str(OLDEST))
        if not (told.isascii() and told.isdigit() and len(told) < 10):
            raise SaccadeError(f"log {self.path} says that its format is {told!r}, which is no number")
        return int(told)


def is_whole(path: Path) -> bool:
    """Whether a log has an end as it is written by a recorder that was told to stop.

    A recorder that was killed, or that ran out of space, leaves a log without an index. `saccade log check` says what
    else a log may lack.
    """
    try:
        with path.open("rb") as stream:
            return stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC and summary_of(stream) is not None
    except OSError:
        return False
