"""Reads the messages of a ROS 2 bag one by one: an MCAP file, an SQLite file, or a folder of either.

The messages come in the order in which they were recorded, which is about that of time. Whatever a file claims, the
memory is bounded by one chunk, or one message.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import quote

import zstandard
from mcap.records import Channel, Header, Message, Schema
from mcap.writer import MCAP0_MAGIC

from saccade.shared.errors import SaccadeError, printable
from saccade.shared.files import MIB, opened, read_text
from saccade.shared.log.foreign import foreign
from saccade.shared.log.records import DAMAGE, records
from saccade.shared.ros.types import READ

MAX_MESSAGE_BYTES = 256 * MIB
MAX_METADATA_BYTES, MOST_FILES = 1 * MIB, 10_000
METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
COMPRESSED_SUFFIXES = (".mcap.zstd", ".db3.zstd")
NEED = "give a ROS 2 bag: a file .mcap or .db3, or the folder of one"
CDR = "cdr"
SQLITE = b"SQLite format 3\0"
ANY_SIZE = 2 ** 62


Wanted = Callable[[str], bool]  # whether a topic is read


def everything(_topic: str) -> bool:
    """Every topic is read."""
    return True


class Raw(NamedTuple):
    """A message as it was recorded: the time is that of the recording. `data` is None if it could not be opened."""

    topic: str
    kind: str
    data: bytes | None
    time_ns: int


class Storage(Protocol):
    """The messages of a file. When they have been read, `cut` says why the file ends early, and is None if it is
    whole."""

    path: Path
    cut: str | None

    def messages(self, wanted: Wanted = everything) -> Iterator[Raw]:
        """Yields the messages of the wanted topics, as far as their types are read. Raises SaccadeError if the file
        cannot be read at all."""


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS bag, by its name and by the names in the folder."""
    if not os.path.isdir(path):
        return path.name.lower().endswith((*SUFFIXES, *COMPRESSED_SUFFIXES, ".bag"))
    try:
        return (path / METADATA).is_file() or any(
            name.lower().endswith((*SUFFIXES, *COMPRESSED_SUFFIXES)) for name in os.listdir(path))
    except OSError:
        return False


def open_bag(path: Path) -> Bag:
    """Opens a bag. Raises SaccadeError if it is not one, is a log of Saccade, or is stored in a way that is not
    known."""
    if not os.path.isdir(path):
        return Bag(path, [_storage(path)])
    paths, compressed = _files_of(path)
    return Bag(path, [_storage(file) for file in paths], compressed=compressed)


class Bag:
    """The messages of a bag, which may have several files. With `compressed` each message is compressed by itself."""

    def __init__(self, path: Path, storages: Sequence[Storage], *, compressed: bool = False) -> None:
        self.path, self._storages, self._compressed = path, storages, compressed

    @property
    def cut(self) -> str | None:
        """Why the bag ends early, as far as it was read. None if it is whole."""
        return next((f"{storage.path.name} {storage.cut}" for storage in self._storages if storage.cut), None)

    def messages(self, wanted: Wanted = everything) -> Iterator[Raw]:
        """Yields the messages of the wanted topics, as far as their types are read, in the order of the files."""
        for storage in self._storages:
            for raw in storage.messages(wanted):
                yield raw._replace(data=_opened(raw.data)) if self._compressed and raw.data is not None else raw


def _opened(data: bytes) -> bytes | None:
    """A message that was compressed by itself. None if it is damaged or too large."""
    try:
        size = zstandard.frame_content_size(data)
        limit = MAX_MESSAGE_BYTES if size < 0 else size
        return zstandard.ZstdDecompressor().decompress(data, limit) if limit <= MAX_MESSAGE_BYTES else None
    except (zstandard.ZstdError, MemoryError):
        return None


class McapBag:
    """The messages of an MCAP file. Raises SaccadeError if it is not one of ROS 2."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut: str | None = None
        with opened(path, "bag", NEED, ANY_SIZE) as stream:
            head = stream.read(len(MCAP0_MAGIC))
            if head != MCAP0_MAGIC:
                raise SaccadeError(f"bag {path} is {'not an MCAP file' if head else 'empty'}: {NEED}")
        if foreign(path) is None and not self._begins_like_ros():
            raise SaccadeError(f"bag {path} is a log of Saccade, or too damaged to be read: {NEED}; `saccade replay` "
                               "replays a log")

    def _begins_like_ros(self) -> bool:
        with self.path.open("rb") as stream:
            try:
                return next((record.profile == "ros2" for record in records(stream, sums=False)
                             if isinstance(record, Header)), False)
            except DAMAGE:
                return False

    def messages(self, wanted: Wanted = everything) -> Iterator[Raw]:
        """Yields the messages in the order of the file, up to where it is cut or damaged."""
        self.cut = None
        kinds: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with opened(self.path, "bag", NEED, ANY_SIZE) as stream:
            try:
                for record in records(stream, schemas=True):
                    if isinstance(record, Message):
                        if record.channel_id in channels:
                            yield Raw(*channels[record.channel_id], record.data, record.log_time)
                    elif isinstance(record, Schema):
                        kinds[record.id] = record.name
                    elif isinstance(record, Channel):
                        kind = kinds.get(record.schema_id, "")
                        if record.message_encoding == CDR and kind in READ and wanted(record.topic):
                            channels[record.id] = (record.topic, kind)
            except DAMAGE as error:
                self.cut = f"is cut or damaged ({printable(str(error) or type(error).__name__, 100)})"


class SqliteBag:
    """The messages of an SQLite file. Raises SaccadeError if it is not one of ROS 2."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut: str | None = None
        with opened(path, "bag", NEED, ANY_SIZE) as stream:
            if (head := stream.read(len(SQLITE))) != SQLITE:
                raise SaccadeError(f"bag {path} is {'not an SQLite file' if head else 'empty'}: {NEED}")
        try:
            with closing(self._connected()) as connection:
                self._topics = self._read_topics(connection)
        except sqlite3.Error as error:
            raise SaccadeError(f"bag {path} cannot be read ({printable(str(error), 100)}): {NEED}") from error

    def _connected(self) -> sqlite3.Connection:
        connection = sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?mode=ro&immutable=1", uri=True,
                                     check_same_thread=False)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        connection.execute("PRAGMA trusted_schema = OFF")
        return connection

    def _read_topics(self, connection: sqlite3.Connection) -> dict[int, tuple[str, str]]:
        """The topics by their number. They must be in tables: views of a file from outside could compute anything."""
        tables = connection.execute("SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', "
                                    "'messages')").fetchone()
        if tables[0] != 2:
            raise SaccadeError(f"bag {self.path} is an SQLite file without messages of ROS 2: {NEED}")
        rows = connection.execute("SELECT id, name, type, serialization_format FROM topics LIMIT 100000")
        return {number: (str(name), str(kind)) for number, name, kind, form in rows if form == CDR}

    def messages(self, wanted: Wanted = everything) -> Iterator[Raw]:
        """Yields the messages in the order in which they were recorded."""
        self.cut = None
        taken = {number: found for number, found in self._topics.items() if found[1] in READ and wanted(found[0])}
        marks = ",".join("?" * len(taken))
        with closing(self._connected()) as connection:
            try:
                for number, time_ns, data in connection.execute(
                        f"SELECT topic_id, timestamp, CASE WHEN length(data) <= {MAX_MESSAGE_BYTES} THEN data END "
                        f"FROM messages WHERE topic_id IN ({marks}) ORDER BY id", tuple(taken)):
                    if isinstance(time_ns, int):
                        yield Raw(*taken[number], data if isinstance(data, bytes) else None, time_ns)
            except sqlite3.Error as error:
                self.cut = f"is cut or damaged ({printable(str(error), 100)})"


def _storage(path: Path) -> Storage:
    name = path.name.lower()
    if name.endswith(".bag"):
        raise SaccadeError(f"{path} is a bag of ROS 1: convert it with `rosbags-convert --src {path} --dst "
                           f"{path.with_suffix('')}`, which comes with saccade[ros], and give the new folder")
    if name.endswith(COMPRESSED_SUFFIXES):
        raise SaccadeError(f"bag {path} is compressed as a whole: decompress it with `zstd -d {path}`, and give "
                           f"{path.with_suffix('')}")
    if not name.endswith(SUFFIXES):
        raise SaccadeError(f"{printable(str(path))} is no file of a bag: {NEED}")
    return McapBag(path) if name.endswith(".mcap") else SqliteBag(path)


def _files_of(folder: Path) -> tuple[list[Path], bool]:
    """The files of a bag's folder in order, and whether each message is compressed. Raises SaccadeError if its
    description cannot be read, names files that are not there, or a compression that is not known."""
    if not (folder / METADATA).is_file():
        names = sorted((name for name in os.listdir(folder)
                        if name.lower().endswith((*SUFFIXES, *COMPRESSED_SUFFIXES))), key=_natural)
        return [folder / name for name in names[:MOST_FILES]], False
    about = _described(folder / METADATA)
    try:
        names = [Path(str(name)).name for name in about["relative_file_paths"]]
        form, mode = (str(about.get(key) or "").lower() for key in ("compression_format", "compression_mode"))
    except (KeyError, TypeError) as error:
        raise SaccadeError(f"bag {folder}: {METADATA} does not name the files of the bag: {NEED}") from error
    if mode in ("", "none"):
        form = mode = ""
    if mode == "message" and form != "zstd":
        raise SaccadeError(f"bag {folder}: its messages are compressed by '{printable(form, 40)}', which is not known; "
                           "only zstd is: write it again with `ros2 bag convert`")
    if not names or len(names) > MOST_FILES:
        raise SaccadeError(f"bag {folder}: {METADATA} names {len(names)} files: {NEED}")
    lacks = [name for name in names if not (folder / name).is_file()]
    if lacks:
        raise SaccadeError(f"bag {folder} lacks the file {printable(lacks[0])}, which {METADATA} names: copy the whole "
                           "folder")
    return [folder / name for name in names], mode == "message"


def _natural(name: str) -> list[str]:
    return [part.zfill(20) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def _described(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    text = read_text(path, "description of a bag", NEED, MAX_METADATA_BYTES)
    try:
        about = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        if not isinstance(about, dict):
            raise TypeError
        return about
    except (YAMLError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise SaccadeError(f"description of a bag {path} is not one of rosbag2: {NEED}") from error
