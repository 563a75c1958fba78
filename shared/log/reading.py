"""Reading the log of a run, whole or not, of today's format or an older one."""

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
from saccade.shared.log.foreign import foreign, is_key
from saccade.shared.log.migrations import OLDEST, Migration
from saccade.shared.log.recording import CONFIGURATION, ENDED_EARLY, KEY, LOG
from saccade.shared.log.records import DAMAGE, records, summary_of

NEED = "give the run.mcap of a run"
ANY_SIZE = 2 ** 63
MOST_NOTES = 1000  # metadata records: ours have a few
MAX_CONFIGURATION_BYTES = 4 * 1024 * 1024


class Recorded(NamedTuple):
    """One entry of a log."""

    topic: Topic
    part: str | None
    payload: bytes
    log_time_ns: int


class RunReader:
    """Reads a log in the order of arrival, its messages as those of today's format. `cut` says, once it is read, why it
    ends before its end (None: it is whole); `refused` counts entries that are no valid messages, `others` those under
    keys that are none of Saccade's; metadata and configuration are there before the first entry. Raises SaccadeError
    for a file that is no log, or one of a format to come. Without `sums` the checksums are not verified: twice as fast.
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
                        if is_key(record.topic):  # else one that someone else added
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
        """What is no message. Raises ValueError where there is more of it than a log has."""
        if isinstance(record, Attachment) and record.name == CONFIGURATION:
            if len(record.data) > MAX_CONFIGURATION_BYTES:
                raise ValueError("the configuration is too large")
            self.configuration = record.data.decode(errors="replace")  # whoever reads it refuses it
        elif isinstance(record, Metadata) and record.name != KEY:
            if len(self.metadata) >= MOST_NOTES and record.name not in self.metadata:
                raise ValueError("there is too much metadata")
            self.metadata[record.name] = dict(record.metadata)

    def require_something(self) -> None:
        """Raises SaccadeError, once the log is read, where it is damaged from its start on."""
        if self.cut is not None and not self.metadata:
            raise SaccadeError(f"{self.path} holds nothing that can be read: it is damaged from its start on; "
                               "`saccade log recover` looks for what is left")

    @property
    def format(self) -> int:
        """The format that the log was written in; known once its first entry has been read. Raises SaccadeError where
        it is no number."""
        told = self.metadata.get(LOG, {}).get("format", str(OLDEST))
        if not (told.isascii() and told.isdigit() and len(told) < 10):
            raise SaccadeError(f"log {self.path} says that its format is {told!r}, which is no number")
        return int(told)


def is_whole(path: Path) -> bool:
    """Whether a log has its end, as a recorder writes it that was told to stop: one that was killed, or had no room,
    has no index. What a log lacks beside it, `saccade log check` says."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC and summary_of(stream) is not None
    except OSError:
        return False
