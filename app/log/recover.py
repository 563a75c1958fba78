"""A good log out of a cut or damaged one: every whole record, with an index, and what could not be kept."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from saccade.app.log.salvage import Salvage, Skipped
from saccade.app.log.source import whole
from saccade.shared.errors import SaccadeError
from saccade.shared.log.recording import ENDED_EARLY, LOG

RECOVERED = "recovered"  # metadata of a recovered log: from which, and what was lost


@dataclass
class Recovered:
    """What was kept of a log and what was not. `nameless`: messages whose key stood in a damaged chunk alone."""

    messages: int = 0
    skipped: list[Skipped] = field(default_factory=list)
    after_cut: int = 0
    ended: bool = True
    ended_early: str | None = None
    nameless: int = 0
    told: Counter = field(default_factory=Counter)  # metadata by name

    def lines(self) -> Iterator[str]:
        """What was lost, a line each; none where nothing was."""
        for stretch in self.skipped:
            held = f", {stretch.messages} messages" if stretch.messages else ""
            yield f"skipped at byte {stretch.offset}: {stretch.reason}, {stretch.size} bytes{held}"
        if self.nameless:
            yield f"left out: {self.nameless} messages whose key stood in a damaged chunk"
        if self.after_cut:
            yield f"lost behind the cut: {self.after_cut} bytes"
        elif not self.ended:
            yield "the recording was not finished: it lacks what was not yet on the disk"
        if self.ended_early is not None:
            yield f"the recording had ended early: {self.ended_early}"
        if self.skipped and not self.told[LOG]:
            yield "the log does not say its format: it is taken for the oldest"


def recover(log: Path, out: Path) -> Recovered:
    """Writes every whole record of `log` into the new file `out`, with its times, in its order, and an index.

    `log` is only read. Raises SaccadeError if it cannot be read or holds no whole message, or if `out` is there
    already or cannot be written.
    """
    source, report = Salvage(log), Recovered()
    with whole(out) as partial, partial.open("wb") as stream:
        copy = Copy(stream, report)
        for record in source.records():
            copy.take(record)
        if not report.messages:
            empty = log.stat().st_size == 0
            raise SaccadeError(f"log {log} " + ("is empty: nothing was recorded" if empty else
                                                "holds no whole message: there is nothing to recover"))
        report.skipped, report.after_cut, report.ended = source.skipped, source.after_cut, source.ended
        copy.close({"log": log.name, "lost": "; ".join(report.lines())})
    return report


class Copy:
    """A new MCAP file of the records of another."""

    def __init__(self, stream: BinaryIO, report: Recovered) -> None:
        self._writer, self._report = Writer(stream), report
        self._writer.start()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._ids: dict[str, int] = {}  # in the new file, of what a channel or a schema says

    def take(self, record: McapRecord) -> None:
        """Appends one record; schemas and channels are written once they have a message."""
        if isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Metadata):
            self._metadata(record)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type,
                                        record.data)

    def close(self, recovered: dict[str, str]) -> None:
        """Says where it comes from and writes the index."""
        self._writer.add_metadata(RECOVERED, recovered)
        self._writer.finish()

    def _message(self, message: Message) -> None:
        channel = self._channels.get(message.channel_id)
        if channel is None:
            self._report.nameless += 1
            return
        self._report.messages += 1
        self._writer.add_message(self._channel(channel), message.log_time, message.data, message.publish_time,
                                 message.sequence)

    def _channel(self, channel: Channel) -> int:
        schema = self._schemas.get(channel.schema_id)
        about = repr((channel, schema))
        if about not in self._ids:
            self._ids[about] = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schema(schema), channel.metadata)
        return self._ids[about]

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        about = repr(schema)
        if about not in self._ids:
            self._ids[about] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._ids[about]

    def _metadata(self, record: Metadata) -> None:
        self._report.told[record.name] += 1
        if record.name == ENDED_EARLY:  # of the recording, not of the recovered log
            self._report.ended_early = record.metadata.get("reason", "")
        elif record.name != RECOVERED:
            self._writer.add_metadata(record.name, record.metadata)
