"""The encoding of messages: MessagePack maps with named fields, in which arrays are an extension type.

Everything that is decoded is checked against the dataclass of the message. MessageError names the field if it is
unknown, missing or there twice, if its type, shape or dtype is wrong, or if a number is not finite. It is also raised
if the payload is too long. Nothing is ever unpickled.
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

from saccade.shared.bus.messages import AnyMessage, ArraySpec, Message, field_types, items_of
from saccade.shared.errors import printable

ARRAY_EXTENSION = 1  # msgpack ext type: msgpack([dtype, shape]) followed by the array's bytes, row-major
MAX_SIDE = 8192
MAX_BYTES = 32 * 1024 * 1024
MAX_SMALL_BYTES = 1024 * 1024  # limit for a message without an image
MAX_TEXT = 4096  # bytes
MAX_LIST = 256
MAX_ITEMS = 32  # messages in a list
MAX_FIELDS = 64
MAX_NAME = 64  # bytes of a field's name
MAX_REASON = 200  # characters
HEADER_BYTES = 128  # the header of an array is always shorter than this
STAMP_BYTES = MAX_TEXT + 512  # the stamp with which a message begins is always shorter than this


class MessageError(ValueError):
    """A payload is not a valid message. The text names the field; it is short and can be printed."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text, MAX_REASON))


def packed_array(value: Any) -> msgpack.ExtType:
    """An array as it is in a message. Raises TypeError if it is none."""
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
    """Returns the bytes of a message. Raises MessageError if the message is not valid, so that no service can publish
    what another one must refuse."""
    payload = msgpack.packb(_map_of(type(message), message), default=packed_array)
    _check_size(type(message), payload)
    return payload


def _map_of(message_type: type[Message], message: Message) -> dict[str, Any]:
    """The checked fields of a message, and of the messages that it lists."""
    fields = {f.name: getattr(message, f.name) for f in dataclasses.fields(message)}
    _check(message_type, fields)
    for name, item_type in _lists(message_type).items():
        if any(not isinstance(item, item_type) or any(getattr(item, n) for n in _lists(item_type))
               for item in fields[name]):
            raise MessageError(f"{name}: not messages of the type {item_type.__name__} that list no others")
        fields[name] = [_map_of(item_type, item) for item in fields[name]]
    return {"type": message_type.__name__, "version": message.VERSION, **fields}


@functools.cache
def _lists(message_type: type[Message]) -> dict[str, type[Message]]:
    """The fields that list messages, with the types of these."""
    found = {name: items_of(hint) for name, hint in field_types(message_type).items()}
    return {name: item_type for name, item_type in found.items() if item_type is not None}


class Stamp(NamedTuple):
    """The fields with which every message begins."""

    run: str
    episode: int
    step: int
    seq: int


def stamp_of(payload: bytes) -> Stamp:
    """Reads the stamp of an encoded message, without the rest of it. Raises MessageError if the payload does not begin
    with a stamp."""
    unpacker = msgpack.Unpacker(max_buffer_size=STAMP_BYTES, max_str_len=STAMP_BYTES)
    unpacker.feed(payload[:STAMP_BYTES])
    try:
        unpacker.read_map_header()
        fields = {unpacker.unpack(): unpacker.unpack() for _ in range(2 + len(Stamp._fields))}
        stamp = Stamp(*(fields[name] for name in Stamp._fields))
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"does not begin with a stamp ({type(error).__name__})") from error
    if [type(value) for value in stamp] != [str, int, int, int] or not all(0 <= n < 2 ** 63 for n in stamp[1:]):
        raise MessageError("does not begin with a stamp")
    return stamp


def decode(message_type: type[AnyMessage], payload: bytes) -> AnyMessage:
    """Decodes a message of this type. Raises MessageError, which names the wrong field, if the payload is not valid."""
    _check_size(message_type, payload)
    count = scan(payload)
    try:
        fields = msgpack.unpackb(payload, ext_hook=_unpack_array, max_str_len=MAX_TEXT, max_array_len=MAX_LIST,
                                 max_map_len=MAX_FIELDS, strict_map_key=True)
    except MessageError:
        raise
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"not msgpack ({type(error).__name__})") from error
    if len(fields) != count:
        raise MessageError("a field is there twice")
    return _message(message_type, fields)


def _message(message_type: type[AnyMessage], fields: dict[str, Any]) -> AnyMessage:
    """A message from its map. Raises MessageError if it is not valid."""
    name, version = fields.pop("type", None), fields.pop("version", None)
    if type(name) is not str or name != message_type.__name__:
        raise MessageError(f"type: not a {message_type.__name__}")
    if type(version) is not int or version != message_type.VERSION:
        told = version if type(version) is int else type(version).__name__
        raise MessageError(f"version: {told}, not {message_type.VERSION}: it comes from another release")
    _check(message_type, fields)
    for field, item_type in _lists(message_type).items():
        fields[field] = [_message(item_type, item) for item in fields[field]]
    return message_type(**fields)


@functools.cache
def _checks(message_type: type[Message]) -> dict[str, tuple[bool, Any]]:
    """For each field: whether it may be absent, and its ArraySpec or its type."""
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
        if not isinstance(value, list) or len(value) > MAX_LIST or not all(isinstance(v, str) for v in value):
            raise MessageError(f"{name}: not a list of at most {MAX_LIST} texts")
        for text in value:
            _check_text(name, text)
    elif items_of(kind) is not None:
        if not isinstance(value, list) or len(value) > MAX_ITEMS or not all(isinstance(v, dict | Message)
                                                                            for v in value):
            raise MessageError(f"{name}: not a list of at most {MAX_ITEMS} messages")
    elif type(value) is not kind:
        raise MessageError(f"{name}: {type(value).__name__}, not {kind.__name__}")
    elif kind is str:
        _check_text(name, value)
    elif kind is int and not 0 <= value < 2 ** 63:
        raise MessageError(f"{name}: out of range")


def _check_text(name: str, text: str) -> None:
    try:
        size = len(text) if text.isascii() else len(text.encode())
    except UnicodeEncodeError as error:
        raise MessageError(f"{name}: a text that is no Unicode") from error
    if size > MAX_TEXT:
        raise MessageError(f"{name}: a text of {size} bytes, more than {MAX_TEXT}")


def _check_size(message_type: type[Message], payload: bytes) -> None:
    limit = limit_of(message_type)
    if len(payload) > limit:
        raise MessageError(f"{len(payload)} bytes, more than {limit}")


def limit_of(message_type: type[Message]) -> int:
    """The largest size of a message of this type, in bytes: one with an image may be larger."""
    return MAX_BYTES if _holds_image(message_type) else MAX_SMALL_BYTES


@functools.cache
def _holds_image(message_type: type[Message]) -> bool:
    return any(isinstance(kind, ArraySpec) and "H" in kind.shape for _, kind in _checks(message_type).values())


# For the first byte of a MessagePack value: its kind, how many bytes give its size, and its size if no bytes give it.
_HEADS = {
    0xC0: ("nil", 0, 0), 0xC2: ("bool", 0, 0), 0xC3: ("bool", 0, 0), 0xCA: ("number", 0, 4), 0xCB: ("number", 0, 8),
    **{0xCC + n: ("number", 0, 2 ** n) for n in range(4)}, **{0xD0 + n: ("number", 0, 2 ** n) for n in range(4)},
    **{0xC4 + n: ("bytes", 2 ** n, 0) for n in range(3)}, **{0xC7 + n: ("array", 2 ** n, 0) for n in range(3)},
    **{0xD4 + n: ("array", 0, 2 ** n) for n in range(5)}, **{0xD9 + n: ("text", 2 ** n, 0) for n in range(3)},
    0xDC: ("list", 2, 0), 0xDD: ("list", 4, 0), 0xDE: ("map", 2, 0), 0xDF: ("map", 4, 0),
    **{n: ("number", 0, 0) for n in (*range(0x80), *range(0xE0, 0x100))},
    **{0x80 + n: ("map", 0, n) for n in range(16)}, **{0x90 + n: ("list", 0, n) for n in range(16)},
    **{0xA0 + n: ("text", 0, n) for n in range(32)},
}


def scan(payload: bytes) -> int:
    """Returns the number of fields in a payload. It only reads the head of each value and builds no objects, however
    long the payload is.

    Raises MessageError if the payload is not one map from names to numbers, truth values, texts, arrays, lists of
    texts, and lists of such maps that have no lists of maps, or if it exceeds a limit.
    """
    count, at = _scan_map(payload, 0, lists=True)
    if at != len(payload):
        raise MessageError(f"{len(payload)} bytes, where its fields take {at}")
    return count


def _scan_map(payload: bytes, at: int, *, lists: bool) -> tuple[int, int]:
    """The number of fields of the map at a position, which may have lists of maps, and the position after it."""
    kind, count, at = _head(payload, at)
    if kind != "map" or count > MAX_FIELDS:
        raise MessageError(f"not a map of at most {MAX_FIELDS} fields")
    for _ in range(count):
        kind, size, at = _head(payload, at)
        if kind != "text" or size > MAX_NAME:
            raise MessageError(f"a field's name is not a text of at most {MAX_NAME} bytes")
        name, start = payload[at:at + size], at + size
        kind, size, at = _head(payload, start)
        if kind in ("map", "bytes"):
            raise _named(name, f"{kind}, which no message has")
        at = _scan_items(payload, at, size, name, maps=lists) if kind == "list" else at + size
    return count, at


def _scan_items(payload: bytes, at: int, count: int, name: bytes, *, maps: bool) -> int:
    """The position after the items of a list, which may be `maps`."""
    if count > MAX_LIST:
        raise _named(name, f"a list of {count}, more than {MAX_LIST}")
    for number in range(count):
        kind, length, content = _head(payload, at)
        if kind == "map" and maps:
            if number >= MAX_ITEMS:
                raise _named(name, f"a list of more than {MAX_ITEMS} messages")
            at = _scan_map(payload, at, lists=False)[1]
            continue
        if kind != "text":
            raise _named(name, f"a list that holds {kind}, not texts")
        at = content + length
    return at


def _named(name: bytes, what: str) -> MessageError:
    return MessageError(f"{name.decode(errors='replace')}: {what}")


def _head(payload: bytes, at: int) -> tuple[str, int, int]:
    """Reads the head of the value at position `at`. Returns its kind, its size (in bytes, or in items of a list or
    map), and the position of its content."""
    if at >= len(payload):
        raise MessageError("ends early")
    kind, width, size = _HEADS.get(payload[at], ("nothing", 0, 0))
    if kind == "nothing":
        raise MessageError("not msgpack")
    if width:
        size = int.from_bytes(payload[at + 1:at + 1 + width], "big")
    if kind == "text" and size > MAX_TEXT:
        raise MessageError(f"a text of {size} bytes, more than {MAX_TEXT}")
    return kind, size + (kind == "array"), at + 1 + width


def _check_array(name: str, value: Any, spec: ArraySpec, dimensions: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(spec.dtype):
        raise MessageError(f"{name}: not an array of {spec.dtype}")
    shape = [dimensions.setdefault(d, n) if isinstance(d, str) else d
             for d, n in zip(spec.shape, value.shape, strict=False)]
    if max(value.shape, default=0) > MAX_SIDE:
        raise MessageError(f"{name}: shape {list(value.shape)}, with a side of more than {MAX_SIDE}")
    if len(spec.shape) != value.ndim or list(value.shape) != shape:
        raise MessageError(f"{name}: shape {list(value.shape)}, not {list(spec.shape)}")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise MessageError(f"{name}: not finite")
