"""Messages on the wire: MessagePack maps with named fields, arrays as one extension type.

Everything decoded is checked against the dataclass: an unknown field, a wrong type, shape or dtype, a value that is not
finite or a payload that is too long raises MessageError, which names the field. Nothing is ever unpickled.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from typing import Annotated, Any, NamedTuple

import msgpack
import numpy as np

from saccade.shared.bus.messages import AnyMessage, ArraySpec, Message, field_types

ARRAY_EXTENSION = 1  # msgpack ext type: msgpack([dtype, shape]) followed by the array's bytes, row-major
MAX_SIDE = 8192
MAX_BYTES = 32 * 1024 * 1024
MAX_TEXT = 4096
HEADER_BYTES = 128  # of an array: more than any needs
STAMP_BYTES = 512  # and of the fields that all messages have


class MessageError(ValueError):
    """A payload that is not a valid message; the text names the field."""


def _pack_array(value: Any) -> msgpack.ExtType:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"cannot encode {type(value).__name__}")
    little = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
    return msgpack.ExtType(ARRAY_EXTENSION, msgpack.packb([little.dtype.str[1:], value.shape]) + little.tobytes())


def _unpack_array(code: int, data: bytes) -> np.ndarray:
    if code != ARRAY_EXTENSION:
        raise MessageError(f"unknown extension type {code}")
    unpacker = msgpack.Unpacker(max_buffer_size=HEADER_BYTES, max_array_len=16, max_str_len=8)
    unpacker.feed(data[:HEADER_BYTES])
    header = unpacker.unpack()
    if not (isinstance(header, list) and len(header) == 2 and header[0] in ("u1", "f4", "f8") and
            isinstance(header[1], list) and len(header[1]) <= 4 and
            all(isinstance(n, int) and 0 <= n <= MAX_SIDE for n in header[1])):
        raise MessageError("an array's header is not [dtype, shape]")
    dtype = np.dtype("<" + header[0]) if header[0] != "u1" else np.dtype("u1")
    start = unpacker.tell()
    if len(data) - start != dtype.itemsize * math.prod(header[1]):
        raise MessageError("an array's bytes do not fill its shape")
    return np.frombuffer(data, dtype, offset=start).reshape(header[1])


def encode(message: Message) -> bytes:
    """The wire bytes of a message; checks it first, so that no service can publish what another must refuse."""
    fields = {f.name: getattr(message, f.name) for f in dataclasses.fields(message)}
    _check(type(message), fields)
    return msgpack.packb({"type": type(message).__name__, "version": message.VERSION, **fields}, default=_pack_array)


class Stamp(NamedTuple):
    """What every message begins with."""

    run: str
    episode: int
    step: int
    seq: int


def stamp_of(payload: bytes) -> Stamp:
    """The stamp of an encoded message, without the rest of it. Raises MessageError for what does not begin with one."""
    unpacker = msgpack.Unpacker(max_buffer_size=STAMP_BYTES, max_str_len=STAMP_BYTES)
    unpacker.feed(payload[:STAMP_BYTES])
    try:
        unpacker.read_map_header()
        fields = {unpacker.unpack(): unpacker.unpack() for _ in range(2 + len(Stamp._fields))}
        stamp = Stamp(*(fields[name] for name in Stamp._fields))
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"does not begin with a stamp ({type(error).__name__})") from error
    if [type(value) for value in stamp] != [str, int, int, int]:
        raise MessageError("does not begin with a stamp")
    return stamp


def decode(message_type: type[AnyMessage], payload: bytes) -> AnyMessage:
    """The message in `payload`. Raises MessageError with the field that is wrong."""
    if len(payload) > MAX_BYTES:
        raise MessageError(f"{len(payload)} bytes, more than {MAX_BYTES}")
    try:
        fields = msgpack.unpackb(payload, ext_hook=_unpack_array, max_str_len=MAX_TEXT, max_array_len=256,
                                 max_map_len=64, strict_map_key=True)
    except MessageError:
        raise
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"not msgpack ({type(error).__name__})") from error
    if not isinstance(fields, dict) or fields.pop("type", None) != message_type.__name__:
        raise MessageError(f"type: not a {message_type.__name__}")
    if (version := fields.pop("version", None)) != message_type.VERSION:
        raise MessageError(f"version: {version!r}, not {message_type.VERSION}: it comes from another release")
    _check(message_type, fields)
    return message_type(**fields)


@functools.cache
def _checks(message_type: type[Message]) -> dict[str, tuple[bool, Any]]:
    """For each field whether it may be absent, and its ArraySpec or type."""
    checks = {}
    for name, hint in field_types(message_type).items():
        optional = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
        if optional:
            hint = next(h for h in typing.get_args(hint) if h is not type(None))
        checks[name] = optional, typing.get_args(hint)[1] if typing.get_origin(hint) is Annotated else hint
    return checks


def _check(message_type: type[Message], fields: dict[str, Any]) -> None:
    checks = _checks(message_type)
    if fields.keys() != checks.keys():
        odd = sorted(fields.keys() ^ checks.keys())
        raise MessageError(f"{odd[0]}: {'unknown' if odd[0] in fields else 'missing'} field")
    dimensions: dict[str, int] = {}
    for name, (optional, kind) in checks.items():
        value = fields[name]
        if not (optional and value is None):
            _check_field(name, value, kind, dimensions)


def _check_field(name: str, value: Any, kind: Any, dimensions: dict[str, int]) -> None:
    if isinstance(kind, ArraySpec):
        _check_array(name, value, kind, dimensions)
    elif kind is float:
        if not isinstance(value, (float, int)) or isinstance(value, bool) or not math.isfinite(value):
            raise MessageError(f"{name}: not a finite number")
    elif kind == list[str]:
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise MessageError(f"{name}: not a list of texts")
    elif type(value) is not kind:
        raise MessageError(f"{name}: {type(value).__name__}, not {kind.__name__}")
    elif kind is int and not 0 <= value < 2 ** 63:
        raise MessageError(f"{name}: out of range")


def _check_array(name: str, value: Any, spec: ArraySpec, dimensions: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(spec.dtype):
        raise MessageError(f"{name}: not an array of {spec.dtype}")
    shape = [dimensions.setdefault(d, n) if isinstance(d, str) else d
             for d, n in zip(spec.shape, value.shape, strict=False)]
    if len(spec.shape) != value.ndim or list(value.shape) != shape or max(value.shape, default=0) > MAX_SIDE:
        raise MessageError(f"{name}: shape {list(value.shape)}, not {list(spec.shape)}")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise MessageError(f"{name}: not finite")
