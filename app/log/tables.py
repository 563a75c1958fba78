"""Writes the messages of one topic as a Parquet table, with a row for each message and columns that follow from its
dataclass.

Texts, numbers and truth values are columns of their own type. Arrays are lists in row-major order. If the message fixes
the shape of an array, the list has a fixed length, and the metadata of the column holds the shape. Otherwise the column
`<name>_shape` gives the shape in each row, and the numbers are left out (null) in a row that has more than a few. Of
images only the shape is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from saccade.app.log.fields import IMAGE, fixed_numbers, kinds, value_of
from saccade.shared.bus.messages import ArraySpec, Belief, Message, Percept
from saccade.shared.bus.topics import Topic
from saccade.shared.log.reading import Recorded

ROW_GROUP = 1024  # rows that are held in memory
MOST_NUMBERS = 64  # of an array that is written in full, such as 21 positions, but no point cloud and no map
TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_(), list[str]: pa.list_(pa.string())}
NUMBERS = {"f4": pa.float32(), "f8": pa.float64()}


class Column(NamedTuple):
    """One column, and the function that gives its value."""

    field: pa.Field
    value: Callable[[Recorded, Message], Any]


class Table:
    """The table of a topic while it is written, `ROW_GROUP` rows at a time."""

    def __init__(self, path: Path, topic: Topic) -> None:
        self.path = path
        self._columns = columns(topic)
        about = {"topic": topic.name, "message": topic.type.__name__, "description": (topic.type.__doc__ or "").strip()}
        self._schema = pa.schema([column.field for column in self._columns], metadata=about)
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd")
        self._rows: list[list[Any]] = []

    def add(self, entry: Recorded, message: Message) -> None:
        """Appends one row, and one for each further message of several of a kind."""
        each = message.each() if isinstance(message, Belief | Percept) else [message]
        self._rows += [[column.value(entry, one) for column in self._columns] for one in each]
        if len(self._rows) >= ROW_GROUP:
            self._write()

    def close(self, lacks: dict[str, str]) -> None:
        """Writes the remaining rows. `lacks` is put into the metadata of the file."""
        self._write()
        self._writer.add_key_value_metadata(lacks)
        self._writer.close()

    def _write(self) -> None:
        if self._rows:
            arrays = [pa.array(values, field.type)
                      for values, field in zip(zip(*self._rows, strict=True), self._schema, strict=True)]
            self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))
            self._rows = []


def columns(topic: Topic) -> list[Column]:
    """The columns of a topic's table: the time, the part, then the fields of the message in their order."""
    result = [Column(pa.field("log_time", pa.timestamp("ns", tz="UTC")), lambda entry, _: entry.log_time_ns)]
    if topic.parts:
        result.append(Column(pa.field("part", pa.string()), lambda entry, _: entry.part))
    for name, kind in kinds(topic.type).items():
        result += _of_array(name, kind) if isinstance(kind, ArraySpec) else [
            Column(pa.field(name, TYPES[kind]), _value(name))]
    return result


def _value(name: str) -> Callable[[Recorded, Message], Any]:
    return lambda _, message: value_of(message, name)


def _of_array(name: str, spec: ArraySpec) -> list[Column]:
    def shape(_: Recorded, message: Message) -> list[int] | None:
        value = getattr(message, name)
        return None if value is None else list(value.shape)

    def numbers(_: Recorded, message: Message) -> np.ndarray | None:
        value = getattr(message, name)
        return None if value is None or value.size > MOST_NUMBERS else value.ravel()

    count = fixed_numbers(spec)
    if count is not None and count <= MOST_NUMBERS:
        told = {"shape": "x".join(str(side) for side in spec.shape)}
        return [Column(pa.field(name, pa.list_(NUMBERS[spec.dtype], count), metadata=told), numbers)]
    shapes = Column(pa.field(f"{name}_shape", pa.list_(pa.int32(), len(spec.shape))), shape)
    if spec.dtype == IMAGE:
        return [shapes]
    return [Column(pa.field(name, pa.list_(NUMBERS[spec.dtype])), numbers), shapes]
