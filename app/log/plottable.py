"""Turns the numbers of a message into a protobuf message of flat fields, which Foxglove and Rerun can both plot.

The schema follows from the dataclass: its scalars, texts and short arrays of fixed length, and its properties. JSON
would be enough for Foxglove, but Rerun keeps JSON as bytes. Rerun splits protobuf into fields by the schema in the
file.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from foxglove import Schema
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from saccade.app.log.fields import IMAGE, fixed_numbers, kinds, value_of
from saccade.app.run.display import Progress, spread_cm
from saccade.shared.bus.messages import ArraySpec, Belief, Message, Plan, Truth

PACKAGE = "saccade"
MOST_NUMBERS = 16  # longer arrays are not worth plotting
PROTOBUF_TYPES = {str: FieldDescriptorProto.TYPE_STRING, int: FieldDescriptorProto.TYPE_INT64,
                  float: FieldDescriptorProto.TYPE_DOUBLE, bool: FieldDescriptorProto.TYPE_BOOL}


def goal_entropy_nats(belief: Belief) -> float | None:
    """Entropy, in nats, of the posterior over the viewing direction of the goal. None while there is no posterior."""
    if belief.goal_log_posterior is None:
        return None
    log_p = belief.goal_log_posterior.astype(np.float64)
    log_p = log_p - np.logaddexp.reduce(log_p, axis=None)
    return float(-(np.exp(log_p) * log_p).sum())


# Values worth plotting that are no field, or whose field uses a number for "unknown". None becomes NaN, a gap.
DERIVED: dict[type[Message], dict[str, Callable[[Any, Progress], float | None]]] = {
    Belief: {"spread_cm": lambda belief, _: spread_cm(belief),
             "goal_entropy_nats": lambda belief, _: goal_entropy_nats(belief)},
    Plan: {"believed_distance_m": lambda _, progress: progress.believed_distance_m},
    Truth: {"distance_m": lambda _, progress: progress.distance_m},
}


class Values:
    """The numbers of one message, after `progress` has taken it. It encodes itself in the same way as Foxglove's own
    messages."""

    def __init__(self, message: Message, progress: Progress) -> None:
        self._type = type(message)
        self._values: dict[str, Any] = {}
        for name in _fields(self._type):
            if (derive := DERIVED.get(self._type, {}).get(name)) is not None:
                value = derive(message, progress)
                self._values[name] = math.nan if value is None else value
            elif (value := value_of(message, name)) is not None:
                self._values[name] = value.ravel().tolist() if isinstance(value, np.ndarray) else value

    def get_schema(self) -> Schema:
        """Returns the protobuf schema of this message's type."""
        files = FileDescriptorSet(file=[_file(self._type)])
        return Schema(name=f"{PACKAGE}.{self._type.__name__}", encoding="protobuf", data=files.SerializeToString())

    def encode(self) -> bytes:
        """Returns the protobuf bytes."""
        return _protobuf_class(self._type)(**self._values).SerializeToString()


@functools.cache
def _fields(message_type: type[Message]) -> dict[str, Any]:
    """Names and kinds of all fields: first the short fields, then the properties, then the derived values."""
    told = {name: kind for name, kind in kinds(message_type).items() if not isinstance(kind, ArraySpec) or (
        kind.dtype != IMAGE and (fixed_numbers(kind) or math.inf) <= MOST_NUMBERS)}
    properties = [name for name, member in vars(message_type).items() if isinstance(member, property)]
    return told | dict.fromkeys([*properties, *DERIVED.get(message_type, {})], float)


@functools.cache
def _file(message_type: type[Message]) -> FileDescriptorProto:
    file = FileDescriptorProto(name=f"{PACKAGE}/{message_type.__name__}.proto", package=PACKAGE, syntax="proto3")
    described = file.message_type.add(name=message_type.__name__)
    for number, (name, kind) in enumerate(_fields(message_type).items(), start=1):
        many = isinstance(kind, ArraySpec) or kind == list[str]
        plain = float if isinstance(kind, ArraySpec) else str if kind == list[str] else kind
        described.field.add(name=name, number=number, type=PROTOBUF_TYPES[plain],
                            label=FieldDescriptorProto.LABEL_REPEATED if many else FieldDescriptorProto.LABEL_OPTIONAL)
    return file


@functools.cache
def _protobuf_class(message_type: type[Message]) -> type:
    pool = DescriptorPool()
    pool.Add(_file(message_type))
    return GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{message_type.__name__}"))
