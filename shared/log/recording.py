"""Writes the log of a run as MCAP. It holds the encoded messages as they were on the bus, and a crash loses little of
it."""

from __future__ import annotations

import contextlib
import json
import os
import time
import typing
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC, Writer

from saccade.shared.bus.messages import ArraySpec, Message, field_types, items_of
from saccade.shared.bus.topics import Topic, parse_key
from saccade.shared.bus.wire import ARRAY_EXTENSION, limit_of
from saccade.shared.errors import SaccadeError
from saccade.shared.log.migrations import FORMAT

FLUSH_S = 0.4  # a chunk is closed this often; a recorder that is killed loses at most this much
CONFIGURATION = "config.json"
ENDED_EARLY = "ended_early"
LOG = "log"  # metadata about the log itself: its format
CUT = "cut"  # metadata of a log that begins later than step 0, or is a part of another log: its steps
AWAITED = "awaited"  # metadata of a run's log that must hold FINISHED at its end
FINISHED = "finished"  # metadata of a run's log whose source has said that it is over: its number of episodes
RECOVERED = "recovered"  # metadata of a recovered log: from which, and what was lost
ENCODING = "msgpack"  # of the messages, as a channel says it
KEY = "key"  # metadata, one for each key: repeats its channel outside of the chunks, in case its chunk is damaged
MOST_KEYS = 4096  # in one log; MCAP has numbers for 65,535
LONGEST_KEY = 256


class RecordingStopped(SaccadeError):
    """The log cannot take any more. What was recorded so far can be read."""


class RunLog:
    """Writes the log of one run. `metadata` maps names to maps of text, such as the versions and the hashes of the
    weights.

    Raises SaccadeError if the file exists or cannot be created. Raises RecordingStopped, once, if the disk is full or
    the log was removed.
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
        writer = Writer(self._file)  # type: ignore[arg-type]  # the Writer only needs write, tell and flush
        self._writer: Writer | None = writer
        self._guarded(self._start, writer, configuration, metadata or {})

    def write(self, topic: Topic, part: str | None, payload: bytes, *, sequence: int = 0,
              log_time_ns: int | None = None) -> None:
        """Appends an encoded message with the time of its arrival, which is now unless given. A message for which
        `refusal` gives a reason is left out."""
        if self._writer is not None:
            now_ns = time.time_ns() if log_time_ns is None else log_time_ns
            if self.refusal(topic, part, payload) is None:
                self._guarded(self._add, self._writer, topic, part, payload, sequence, now_ns)
            self.flush_if_due()

    def refusal(self, topic: Topic, part: str | None, payload: bytes) -> str | None:
        """Returns the reason why the log does not take this message, or None if it takes it."""
        key = topic.key(self._world, part)
        if key not in self._channels:
            if len(self._channels) >= MOST_KEYS:
                return f"a log takes {MOST_KEYS} keys at most"
            if len(key) > LONGEST_KEY or not key.isprintable():
                return f"a log takes keys of at most {LONGEST_KEY} printable characters"
        limit = limit_of(topic.type)
        if len(payload) > limit:
            return f"a log takes messages of {topic.name} of at most {limit} bytes"
        return None

    def note(self, name: str, values: Mapping[str, object]) -> None:
        """Adds metadata."""
        if self._writer is not None:
            self._guarded(self._writer.add_metadata, name, {k: str(v) for k, v in values.items()})

    def flush_if_due(self) -> None:
        """Must be called at least every FLUSH_S seconds while nothing is written."""
        if time.monotonic() - self._flushed_s >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Brings everything that was written so far to the disk."""
        if self._writer is not None:
            self._flushed_s = time.monotonic()
            self._guarded(self._writer.flush)
            self._guarded(self._file.sync)
            self._stop_if_gone()

    def close(self) -> None:
        """Writes the index and closes the file."""
        if self._writer is not None:
            self._guarded(self._writer.finish)
            self._guarded(self._file.sync)
            self._stop_if_gone()
            self._writer = None
        self._file.close()

    def _guarded(self, action: Callable[..., object], *arguments: object) -> None:
        try:
            action(*arguments)
        except OSError as error:
            self._writer = None
            self._file.end_early(error.strerror or str(error))
            self._file.close()
            raise RecordingStopped(f"recording stopped ({error.strerror}): {self.path} keeps what was recorded; "
                                   "free some space before the next run") from error

    def _stop_if_gone(self) -> None:
        """Raises RecordingStopped if the file was removed. One could go on writing into it, but it would be lost once
        it is closed."""
        if self._file.is_gone():
            self._writer = None
            self._file.close()
            what = "file" if self.path.parent.is_dir() else "folder"
            raise RecordingStopped(f"recording stopped: the log's {what} is gone ({self.path}): what is recorded from "
                                   "now on is lost; leave the folder of a run where it is until the run has ended")

    def _start(self, writer: Writer, configuration: str, metadata: Mapping[str, Mapping[str, str]]) -> None:
        writer.start()
        for name, values in {LOG: {"format": FORMAT}, **metadata}.items():
            writer.add_metadata(name, {str(k): str(v) for k, v in values.items()})
        now = time.time_ns()
        writer.add_attachment(now, now, CONFIGURATION, "application/json", configuration.encode())

    def _add(self, writer: Writer, topic: Topic, part: str | None, payload: bytes, sequence: int,
             log_time_ns: int) -> None:
        key = topic.key(self._world, part)
        if key not in self._channels:
            name = topic.type.__name__
            if name not in self._schemas:
                text = json.dumps(json_schema(topic.type), sort_keys=True).encode()
                self._schemas[name] = writer.register_schema(name, "jsonschema", text)
            channel = self._channels[key] = writer.register_channel(key, ENCODING, self._schemas[name])
            writer.add_metadata(KEY, key_metadata(channel, key))
        log_time_ns = min(max(log_time_ns, 0), 2 ** 63 - 1)
        writer.add_message(self._channels[key], log_time_ns, payload, log_time_ns, sequence % 2 ** 32)
        self.messages += 1


class _WholeRecords:
    """The file below mcap's Writer. It keeps whole records only: a record that does not fit leaves nothing behind."""

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        self._raw = path.open("xb", buffering=0)  # a log is never overwritten
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
        """Does nothing, because nothing is held back."""

    def sync(self) -> None:
        os.fdatasync(self._raw.fileno())

    def is_gone(self) -> bool:
        """Whether the file was removed. A file that was moved or renamed is still there."""
        held = os.fstat(self._raw.fileno())
        with contextlib.suppress(OSError):
            if os.path.samestat(held, os.stat(self._path)):
                return False
        return held.st_nlink == 0

    def end_early(self, reason: str) -> None:
        """Cuts off a half-written record. If there is room, it also ends the file as MCAP demands, without an index."""
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


def key_metadata(channel: int, key: str) -> dict[str, str]:
    """Returns the metadata KEY of a channel. It has a checksum of its own, because MCAP has none for records outside of
    chunks."""
    return {"channel": str(channel), "key": key, "crc32": str(zlib.crc32(f"{channel} {key}".encode()))}


def channel_of(values: Mapping[str, str]) -> Channel | None:
    """Returns the channel that a metadata KEY describes, without its schema. Returns None if the metadata is not as it
    was written."""
    channel, key = values.get("channel", ""), values.get("key", "")
    if not channel.isdecimal() or values != key_metadata(int(channel[:6]), key):
        return None
    try:
        parse_key(key)
    except SaccadeError:
        return None
    return Channel(id=int(channel), topic=key, message_encoding=ENCODING, metadata={}, schema_id=0)


def json_schema(message_type: type[Message]) -> dict[str, Any]:
    """Returns the JSON Schema of a message's MessagePack map. Arrays are extension type 1; their dtype and shape are
    given beside it."""
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
    if (item_type := items_of(hint)) is not None:  # of the same kind, but without any of its own
        return {"type": "array", "items": {"$ref": "#"}, "description": f"messages of the type {item_type.__name__}"}
    simple = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}
    if hint in simple:
        return {"type": simple[hint]}
    return {"anyOf": [_field_schema(h) for h in typing.get_args(hint)]}
