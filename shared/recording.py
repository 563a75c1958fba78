"""The log of a run as MCAP: the wire bytes as they were. A crash loses little of it, and the reader says so."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import time
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, DataEnd, Footer, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer
from zstandard import ZstdError

from shared.errors import SaccadeError
from shared.messages import ARRAY_EXTENSION, ArraySpec, Message, MessageError, decode, field_types
from shared.stepper import GapCounter
from shared.topics import TRUTH, Topic, parse_key

FLUSH_S = 0.4  # a chunk is closed this often: what a killed recorder may lose
CONFIGURATION = "config.json"
ENDED_EARLY = "ended_early"
MAX_RECORD_BYTES = 512 * 1024 * 1024
DAMAGE = (McapError, struct.error, ZstdError, ValueError, OverflowError, MemoryError)


class RecordingStopped(SaccadeError):
    """The log can take no more; what was recorded stays readable."""


class RunLog:
    """Writes one run's log. `metadata`: names to maps of text, such as versions and weights' hashes.

    Raises SaccadeError if the file cannot be created or is there already; RecordingStopped, once, when it is full.
    """

    def __init__(self, path: Path, *, world: str, configuration: str = "{}",
                 metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        self.path, self.messages, self._world = path, 0, world
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._flushed_s = time.monotonic()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _WholeRecords(path)
        except OSError as error:
            raise SaccadeError(f"log {path} cannot be written: {error.strerror}") from error
        self._writer: Writer | None = Writer(self._file)
        self._guarded(self._start, configuration, metadata or {})

    def write(self, topic: Topic, part: str | None, payload: bytes, *, sequence: int = 0,
              log_time_ns: int | None = None) -> None:
        """Appends wire bytes, at the time of their arrival (now unless given)."""
        if self._writer is not None:
            now_ns = time.time_ns() if log_time_ns is None else log_time_ns
            self._guarded(self._add, topic, part, payload, sequence, now_ns)
            self.flush_if_due()

    def flush_if_due(self) -> None:
        """To be called at least every FLUSH_S seconds while nothing is written."""
        if self._writer is not None and time.monotonic() - self._flushed_s >= FLUSH_S:
            self._flushed_s = time.monotonic()
            self._guarded(lambda: (self._writer.flush(), self._file.sync()))

    def close(self) -> None:
        """Writes the index and closes the file."""
        if self._writer is not None:
            self._guarded(self._writer.finish)
            self._guarded(self._file.sync)
            self._writer = None
        self._file.close()

    def _guarded(self, action, *arguments) -> None:
        try:
            action(*arguments)
        except OSError as error:
            self._writer = None
            self._file.end_early(error.strerror or str(error))
            self._file.close()
            raise RecordingStopped(f"recording stopped ({error.strerror}): {self.path} keeps what was recorded; "
                                   "free some space before the next run") from error

    def _start(self, configuration: str, metadata: Mapping[str, Mapping[str, str]]) -> None:
        self._writer.start()
        for name, values in metadata.items():
            self._writer.add_metadata(name, {str(k): str(v) for k, v in values.items()})
        now = time.time_ns()
        self._writer.add_attachment(now, now, CONFIGURATION, "application/json", configuration.encode())

    def _add(self, topic: Topic, part: str | None, payload: bytes, sequence: int, log_time_ns: int) -> None:
        key = topic.key(self._world, part)
        if key not in self._channels:
            name = topic.type.__name__
            if name not in self._schemas:
                text = json.dumps(json_schema(topic.type), sort_keys=True).encode()
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
            self._channels[key] = self._writer.register_channel(key, "msgpack", self._schemas[name])
        self._writer.add_message(self._channels[key], log_time_ns, payload, log_time_ns, sequence % 2 ** 32)
        self.messages += 1


class _WholeRecords:
    """The file below mcap's Writer, which writes whole records only: of one that does not fit nothing is left."""

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)  # a log is never written over
        self._end = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._raw.write(rest):]
        self._end += len(data)
        return len(data)

    def tell(self) -> int:
        return self._end

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        os.fdatasync(self._raw.fileno())

    def end_early(self, reason: str) -> None:
        """Cuts off a half-written record and, where there is room, ends the file as MCAP asks, without an index."""
        ending = RecordBuilder()
        Metadata(name=ENDED_EARLY, metadata={"reason": reason}).write(ending)
        DataEnd(0).write(ending)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(ending)
        try:
            self._raw.truncate(self._end)
            self._raw.seek(self._end)
            self.write(ending.end() + MCAP0_MAGIC)
        except OSError:
            self._raw.truncate(self._end)

    def close(self) -> None:
        self._raw.close()


class Recorded(NamedTuple):
    """One entry of a log."""

    topic: Topic
    part: str | None
    payload: bytes
    log_time_ns: int


class RunReader:
    """Reads a log in the order of arrival. `cut` says, once it is read, why it ends before its end (None: it is whole);
    `refused` counts entries that are no valid messages. Raises SaccadeError for a file that is no log."""

    def __init__(self, path: Path) -> None:
        self.path, self.world = path, ""
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
        """Every entry as it was recorded, valid or not."""
        self.cut, self.refused, channels = None, 0, {}
        with self.path.open("rb") as stream:
            try:
                reader = StreamReader(stream, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
                for record in reader.records:
                    if isinstance(record, Channel):
                        with contextlib.suppress(SaccadeError):  # a channel that someone else added
                            self.world, *channels[record.id] = parse_key(record.topic)
                    elif isinstance(record, McapMessage) and record.channel_id in channels:
                        yield Recorded(*channels[record.channel_id], record.data, record.log_time)
                    elif isinstance(record, Attachment) and record.name == CONFIGURATION:
                        self.configuration = record.data.decode()
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = dict(record.metadata)
            except DAMAGE as error:
                self.cut = f"log {self.path} is cut or damaged ({type(error).__name__}); it is read up to there"
        if self.cut is None and ENDED_EARLY in self.metadata:
            self.cut = f"log {self.path} ended early: {self.metadata[ENDED_EARLY].get('reason', '')}"


@dataclass
class Missing:
    """What a log lacks. `lost`: messages per key, by sequence number. `absent`: (run, episode, step, key) of topics
    that every step should have. `cut`: why the file is not whole."""

    messages: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    absent: list[tuple[str, int, int, str]] = field(default_factory=list)
    refused: int = 0
    cut: str | None = None

    @property
    def complete(self) -> bool:
        """Nothing is missing."""
        return not (self.lost or self.absent or self.refused or self.cut)


def missing(path: Path) -> Missing:
    """Reads a log and reports gaps. The last step of an episode that is done needs no answer to its frame."""
    report, reader, gaps = Missing(), RunReader(path), GapCounter(from_start=True)
    steps: dict[tuple[str, int, int], set[str]] = {}
    done: set[tuple[str, int, int]] = set()
    keys: set[str] = set()
    for topic, part, message in reader:
        report.messages += 1
        key = topic.key(reader.world, part)
        if lost := gaps.lost(topic, part, message):
            report.lost[key] = report.lost.get(key, 0) + lost
        if topic.in_step and not topic.latched:
            at = (message.run, message.episode, message.step)
            keys.add(key)
            steps.setdefault(at, set()).add(key)
            if topic == TRUTH and message.done:
                done.add(at)
    for run, episode in {at[:2] for at in steps}:
        for step in range(max(at[2] for at in steps if at[:2] == (run, episode)) + 1):
            at = (run, episode, step)
            if at not in done:
                report.absent += [(*at, key) for key in sorted(keys - steps.get(at, set()))]
    report.absent.sort()
    report.refused, report.cut = reader.refused, reader.cut
    return report


def json_schema(message_type: type[Message]) -> dict[str, Any]:
    """JSON Schema of a message's MessagePack map. Arrays are extension type 1; their dtype and shape stand beside."""
    fields = field_types(message_type)
    properties = {"type": {"const": message_type.__name__}, "version": {"const": message_type.VERSION}}
    properties |= {name: _field_schema(hint) for name, hint in fields.items()}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": message_type.__name__,
            "description": (message_type.__doc__ or "").strip(), "type": "object", "properties": properties,
            "required": ["type", "version", *fields], "additionalProperties": False}


def _field_schema(hint: Any) -> dict[str, Any]:
    if typing.get_origin(hint) is Annotated:
        spec: ArraySpec = typing.get_args(hint)[1]
        return {"type": "array", "description": f"{spec.dtype} {list(spec.shape)}, row-major, MessagePack extension",
                "x-extension": ARRAY_EXTENSION, "x-dtype": spec.dtype, "x-shape": list(spec.shape)}
    if hint == list[str]:
        return {"type": "array", "items": {"type": "string"}}
    simple = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}
    if hint in simple:
        return {"type": simple[hint]}
    return {"anyOf": [_field_schema(h) for h in typing.get_args(hint)]}
