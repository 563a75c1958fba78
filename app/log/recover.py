"""Makes a good log out of a cut or damaged one. It holds every whole record, an index, and a note of what was lost."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, Writer

from saccade.app.log.salvage import Salvage, Skipped
from saccade.app.log.source import whole
from saccade.shared.bus.topics import parse_key
from saccade.shared.errors import SaccadeError, printable
from saccade.shared.files import opened
from saccade.shared.log.foreign import NAME_LIMIT, describe, foreign, is_ours
from saccade.shared.log.reading import ANY_SIZE, MOST_NOTES, NEED
from saccade.shared.log.recording import ENDED_EARLY, KEY, LOG, RECOVERED, channel_of, json_schema, key_metadata

LOST_LIMIT = 20_000  # characters of the note in the new file about what was lost


@dataclass
class Recovered:
    """What was kept of a log, and what was lost.

    `nameless`: messages whose key was only given in a damaged chunk. `after_cut`: bytes that were lost behind the cut.
    """

    messages: int = 0
    skipped: list[Skipped] = field(default_factory=list)
    after_cut: int = 0
    ended: bool = True
    ended_early: str | None = None
    nameless: int = 0
    told: Counter = field(default_factory=Counter)  # metadata by name
    left_out: int = 0  # records of metadata beyond what a log has
    profile: str = ""
    ours: bool = False  # whether any message is under a key of Saccade's

    def lines(self) -> Iterator[str]:
        """Yields one line for each thing that was lost."""
        for stretch in self.skipped:
            held = f", {stretch.messages} messages" if stretch.messages else ""
            yield f"skipped at byte {stretch.offset}: {stretch.reason}, {stretch.size} bytes{held}"
        if self.nameless:
            yield f"left out: {self.nameless} messages whose key stood in a damaged chunk"
        if self.left_out:
            yield f"left out: {self.left_out} records of metadata, more than a log has"
        if self.after_cut:
            yield f"lost behind the cut: {self.after_cut} bytes"
        elif not self.ended:
            yield "the recording was not finished: it lacks what was not yet on the disk"
        if self.ended_early is not None:
            yield f"the recording had ended early: {printable(self.ended_early)}"
        if self.skipped and not self.told[LOG]:
            yield "the log does not say its format: it is taken for the oldest"


def recover(log: Path, out: Path) -> Recovered:
    """Writes every whole record of `log` into the new file `out`, with its times and in its order, and adds an index.

    `log` is only read. Raises SaccadeError if `log` cannot be read, is not a log of Saccade or holds no whole message,
    and if `out` exists or cannot be written.
    """
    with opened(log, "log", NEED, ANY_SIZE) as stream:
        is_mcap = stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    if is_mcap and (other := foreign(log)) is not None:
        raise SaccadeError(other)
    channels: dict[int, Channel] = {}
    with whole(out) as partial:
        report = _copied(log, partial, channels)
        if report.nameless and channels:  # their channel may have come after them
            report = _copied(log, partial, channels)
        if not report.messages:
            raise SaccadeError(f"log {log} " + (
                "is empty: nothing was recorded" if log.stat().st_size == 0 else
                "holds no whole message: there is nothing to recover" if is_mcap else
                "is not an MCAP file, and holds no whole message of one: there is nothing to recover"))
        if not report.ours:
            raise SaccadeError(describe(log, report.profile, [channel.topic for channel in channels.values()]))
    return report


def _copied(log: Path, out: Path, channels: dict[int, Channel]) -> Recovered:
    """Writes the new file. `channels` holds the channels that are known before; afterwards it also holds those that
    were found."""
    source, report = Salvage(log), Recovered()
    with out.open("wb") as stream:
        copy = Copy(stream, report, channels)
        for record in source.records():
            copy.take(record)
        report.skipped, report.after_cut, report.ended = source.skipped, source.after_cut, source.ended
        copy.close({"log": log.name, "lost": printable("; ".join(report.lines()), LOST_LIMIT)})
    return report


class Copy:
    """A new MCAP file that is made of the records of another one."""

    def __init__(self, stream: BinaryIO, report: Recovered, channels: dict[int, Channel]) -> None:
        self._writer, self._report = Writer(stream), report
        self._writer.start()
        self._schemas: dict[int, Schema] = {}
        self._found, self._channels = channels, dict(channels)
        self._ids: dict[str, int] = {}  # ids in the new file, by the content of a channel or schema
        self._known: dict[int, tuple[Channel, Schema | None, int]] = {}  # by old id, with the new id

    def take(self, record: McapRecord) -> None:
        """Appends one record. A schema or a channel is written when it has a message."""
        if isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Channel):
            self._channels[record.id] = self._found[record.id] = record
        elif isinstance(record, Header):
            self._report.profile = record.profile[:NAME_LIMIT]
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Metadata):
            self._metadata(record)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type,
                                        record.data)

    def close(self, recovered: dict[str, str]) -> None:
        """Writes where the log comes from, and the index."""
        self._writer.add_metadata(RECOVERED, recovered)
        self._writer.finish()

    def _message(self, message: Message) -> None:
        channel = self._channels.get(message.channel_id)
        if channel is None:
            self._report.nameless += 1
            return
        self._report.messages += 1
        self._report.ours |= is_ours(channel)
        self._writer.add_message(self._channel(channel), message.log_time, message.data, message.publish_time,
                                 message.sequence)

    def _channel(self, channel: Channel) -> int:
        schema = self._schemas.get(channel.schema_id)
        known = self._known.get(channel.id)
        if known is not None and known[0] is channel and known[1] is schema:
            return known[2]
        about = repr((channel, schema))
        if about not in self._ids:
            if schema is None and is_ours(channel):
                schema = _schema_of(channel.topic)
            new = self._ids[about] = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schema(schema), channel.metadata)
            if is_ours(channel):
                self._writer.add_metadata(KEY, key_metadata(new, channel.topic))
        self._known[channel.id] = channel, self._schemas.get(channel.schema_id), self._ids[about]
        return self._ids[about]

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        about = repr(schema)
        if about not in self._ids:
            self._ids[about] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._ids[about]

    def _metadata(self, record: Metadata) -> None:
        if record.name == KEY:
            channel = channel_of(record.metadata)
            if channel is not None:
                self._channels.setdefault(channel.id, channel)
            return
        if self._report.told.total() >= MOST_NOTES // 2:  # the new log has metadata of its own
            self._report.left_out += 1
            return
        self._report.told[record.name] += 1
        if record.name == ENDED_EARLY:  # the recording ended early, not the recovered log
            self._report.ended_early = record.metadata.get("reason", "")
        elif record.name != RECOVERED:
            self._writer.add_metadata(record.name, record.metadata)


def _schema_of(key: str) -> Schema:
    """Returns the schema of a key's messages, for a file that has lost its own."""
    message_type = parse_key(key)[1].type
    text = json.dumps(json_schema(message_type), sort_keys=True).encode()
    return Schema(id=0, data=text, encoding="jsonschema", name=message_type.__name__)
