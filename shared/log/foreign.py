"""Recognises MCAP files that are not logs of Saccade, so that they are refused with their description before they are
read."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata

from saccade.shared.bus.topics import parse_key
from saccade.shared.errors import SaccadeError, printable
from saccade.shared.log.recording import AWAITED, CONFIGURATION, ENCODING, KEY, LOG
from saccade.shared.log.records import DAMAGE, records, summary_of, within

NAMED = 2  # so many topics are named one by one
NAME_LIMIT = 60  # characters of a name in the description
LOOKED_AT_BYTES = 64 * 1024 * 1024  # looked at in a file that does not list its topics at its end


def is_key(topic: str) -> bool:
    """Whether the topic of a channel is a key of Saccade's that can be printed."""
    try:
        parse_key(topic)
    except SaccadeError:
        return False
    return topic.isprintable()


def is_ours(channel: Channel) -> bool:
    """Whether a channel holds messages of Saccade's."""
    return channel.message_encoding == ENCODING and is_key(channel.topic)


def foreign(path: Path) -> str | None:
    """Describes an MCAP file that holds nothing of Saccade's. Returns None for a log, and for a file that is too
    damaged to tell. Raises OSError if the file cannot be read."""
    found = _Found()
    with path.open("rb") as stream:
        whole = found.look_through(stream)
        if whole is None:
            return None
        if found.topics or found.profile or whole:
            return describe(path, found.profile, list(found.topics.values()))
    return None


def describe(path: Path, profile: str, topics: list[str]) -> str:
    """Describes in words a file that is not a log of Saccade."""
    what = f" of profile '{printable(profile, NAME_LIMIT)}'" if profile else ""
    names = ", ".join(printable(topic, NAME_LIMIT) for topic in sorted(topics)[:NAMED])
    more = f" (and {len(topics) - NAMED} more)" if len(topics) > NAMED else ""
    held = f"with the topic{'s' * (len(topics) > 1)} {names}{more}" if topics else "without any topic"
    return f"{path} is an MCAP{what} {held}, not a log of Saccade: give the run.mcap of a run"


class _Found:
    """What was found in a file."""

    def __init__(self) -> None:
        self.profile = ""
        self.topics: dict[int, str] = {}

    def look_through(self, stream: BinaryIO) -> bool | None:
        """Returns whether the file was whole as far as it was looked at. Returns None as soon as something of Saccade's
        is found."""
        try:
            for record in records(stream, sums=False):
                if isinstance(record, Header):
                    self.profile = record.profile[:NAME_LIMIT]
                elif isinstance(record, Channel):
                    self.topics[record.id] = record.topic[:NAME_LIMIT]
                if _is_ours(record):
                    return None
                if isinstance(record, Channel):  # one is enough if the end of the file lists the others
                    break
                if stream.tell() > LOOKED_AT_BYTES:
                    return True
            if (text := summary_of(stream)) is not None:
                for record in within(text, (Opcode.CHANNEL,)):
                    if _is_ours(record):
                        return None
                    self.topics[record.id] = record.topic[:NAME_LIMIT]
                return True
            return self._look_further(stream)
        except DAMAGE:
            return False

    def _look_further(self, stream: BinaryIO) -> bool | None:
        stream.seek(0)
        for record in records(stream, sums=False):
            if _is_ours(record):
                return None
            if isinstance(record, Channel):
                self.topics[record.id] = record.topic[:NAME_LIMIT]
            if stream.tell() > LOOKED_AT_BYTES:
                return True
        return True


def _is_ours(record: object) -> bool:
    if isinstance(record, Channel):
        return is_ours(record)
    if isinstance(record, Metadata):
        return record.name in (LOG, AWAITED, KEY)
    return isinstance(record, Attachment) and record.name == CONFIGURATION
