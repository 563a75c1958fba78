"""What is encoded comes back the same; what is not a message is refused, and the field that is wrong is named."""

from __future__ import annotations

import dataclasses

import msgpack
import numpy as np
import pytest

from saccade.shared.bus.messages import Action, Frame, Goal, Message, Percept, field_types
from saccade.shared.bus.topics import TOPICS
from saccade.shared.bus.wire import (
    ARRAY_EXTENSION,
    MAX_BYTES,
    MAX_SIDE,
    MAX_SMALL_BYTES,
    MAX_TEXT,
    MessageError,
    decode,
    encode,
    packed_array,
    stamp_of,
)
from saccade.shared.loop.stepper import settle
from saccade.tests.samples import array_fields, sample

TYPES = sorted({topic.type for topic in TOPICS.values()}, key=lambda t: t.__name__)
every_type = pytest.mark.parametrize("kind", TYPES, ids=lambda t: t.__name__)
every_array = pytest.mark.parametrize(("kind", "name"), [(t, n) for t in TYPES for n in array_fields(t)],
                                      ids=lambda v: v if isinstance(v, str) else v.__name__)


def equal(a: Message, b: Message) -> bool:
    """Field by field, arrays by dtype and value."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
            if not (isinstance(x, np.ndarray) and isinstance(y, np.ndarray) and x.dtype == y.dtype and
                    np.array_equal(x, y)):
                return False
        elif x != y or type(x) is not type(y):
            return False
    return type(a) is type(b)


def wire(message: Message, **changes) -> bytes:
    """The message's map with some entries replaced (None of them checked) or, where the value is `...`, left out."""
    fields = {"type": type(message).__name__, "version": message.VERSION}
    fields |= {f.name: getattr(message, f.name) for f in dataclasses.fields(message)} | changes
    return msgpack.packb({k: v for k, v in fields.items() if v is not ...}, default=packed_array)


@every_type
def test_round_trip(kind):
    original = sample(kind)
    assert equal(decode(kind, encode(original)), original)
    assert encode(decode(kind, encode(original))) == encode(original)


@every_type
def test_optional_fields_may_be_absent(kind):
    optional = [n for n, h in field_types(kind).items() if type(None) in getattr(h, "__args__", ())]
    original = sample(kind, **dict.fromkeys(optional))
    assert equal(decode(kind, encode(original)), original)


@every_type
def test_fields_missing_unknown_or_of_another_type_are_refused(kind):
    message = sample(kind)
    for name in field_types(kind):
        with pytest.raises(MessageError, match=f"{name}: missing"):
            decode(kind, wire(message, **{name: ...}))
        with pytest.raises(MessageError, match=f"{name}: "):
            decode(kind, wire(message, **{name: {"a": 1}}))
    with pytest.raises(MessageError, match="extra: unknown"):
        decode(kind, wire(message, extra=1))
    with pytest.raises(MessageError, match="version"):
        decode(kind, wire(message, version=kind.VERSION + 1))


@every_type
def test_another_types_message_is_refused(kind):
    other = next(t for t in TYPES if t is not kind)
    with pytest.raises(MessageError, match="type"):
        decode(kind, encode(sample(other)))


@every_type
def test_what_is_not_msgpack_is_refused(kind):
    whole = encode(sample(kind))
    for payload in (b"", b"\xc1", b"hello", whole[:-1], whole + b"\x00", msgpack.packb([1, 2]), msgpack.packb(7)):
        with pytest.raises(MessageError):
            decode(kind, payload)


@every_type
def test_oversized_payloads_and_texts_are_refused(kind):
    limit = MAX_BYTES if kind in (Frame, Goal) else MAX_SMALL_BYTES
    with pytest.raises(MessageError, match=f"more than {limit}"):
        decode(kind, bytes(limit + 1))
    with pytest.raises(MessageError):
        decode(kind, wire(sample(kind), run="x" * (MAX_TEXT + 1)))


@every_type
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), True, "1"])
def test_numbers_are_finite(kind, value):
    for name, hint in field_types(kind).items():
        if hint is float:
            with pytest.raises(MessageError, match=name):
                decode(kind, wire(sample(kind), **{name: value}))
            with pytest.raises(MessageError, match=name):
                encode(sample(kind, **{name: value}))


@every_type
@pytest.mark.parametrize("value", [-1, 2 ** 63, 1.0, True])
def test_counts_are_whole_and_in_range(kind, value):
    for name in ("episode", "step", "seq"):
        with pytest.raises(MessageError, match=name):
            decode(kind, wire(sample(kind), **{name: value}))


@every_array
def test_arrays_of_another_dtype_or_shape_are_refused(kind, name):
    message = sample(kind)
    good = getattr(message, name)
    other = np.zeros(good.shape, "f4" if good.dtype != np.float32 else "f8")
    for bad in (other, good[None], good.ravel()[0], good.tolist()):
        with pytest.raises(MessageError, match=name):
            decode(kind, wire(message, **{name: bad if not np.isscalar(bad) else float(bad)}))
    if good.dtype.kind == "f":
        for value in (np.nan, np.inf):
            bad = good.copy()
            bad.flat[-1] = value
            with pytest.raises(MessageError, match=name):
                decode(kind, wire(message, **{name: bad}))


def test_dimensions_of_the_same_name_must_agree():
    message = sample(Frame)
    with pytest.raises(MessageError, match="depth_m"):
        encode(dataclasses.replace(message, depth_m=message.depth_m[:-1]))


@pytest.mark.parametrize("data", [
    b"", b"\x92", msgpack.packb(["O", [1]]) + bytes(8), msgpack.packb(["f8", [2]]) + bytes(8),
    msgpack.packb(["f8", [-1]]), msgpack.packb(["f8", [MAX_SIDE + 1]]) + bytes(8 * (MAX_SIDE + 1)),
    msgpack.packb(["f8", [2 ** 40, 2 ** 40]]), msgpack.packb(["f8", ["4"]]) + bytes(32), msgpack.packb({"f8": 1}),
], ids=range(9))
def test_array_headers_are_checked(data):
    payload = wire(sample(Action), translation_m=msgpack.ExtType(ARRAY_EXTENSION, data))
    with pytest.raises(MessageError):
        decode(Action, payload)
    with pytest.raises(MessageError):
        decode(Action, wire(sample(Action), translation_m=msgpack.ExtType(2, bytes(24))))


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda t: t.name)
def test_the_stamp_is_that_of_the_whole_message(topic):
    message = sample(topic.type, run="r" * 200, episode=2 ** 40, step=5, seq=0)
    assert stamp_of(encode(message)) == (message.run, message.episode, message.step, message.seq)


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", encode(sample(Action))[:20],
                                     encode(sample(Action)).replace(b"\xa4step\x03", b"\xa4step\xc0")])
def test_what_does_not_begin_with_a_stamp_is_refused(payload):
    with pytest.raises(MessageError, match="stamp"):
        stamp_of(payload)


# --- messages that list others

def test_further_ones_of_a_kind_travel_with_the_first():
    """Their arrays come back as they were, aligned and read-only as those of the first once a service takes them."""
    second = sample(Percept, object="mug", presence=0.25)
    back = decode(Percept, encode(sample(Percept, object="mug", further=[second])))
    assert [each.presence for each in back.each()] == [0.5, 0.25]
    np.testing.assert_array_equal(back.further[0].rotations, second.rotations)
    inner = settle(back).further[0].pixel
    assert inner.flags.aligned
    assert not inner.flags.writeable


@pytest.mark.parametrize(("further", "complaint"), [
    ([sample(Percept, further=[sample(Percept)])], "further: not messages of the type Percept that list no others"),
    ([sample(Action)], "further: not messages of the type Percept"),
    ("mug", "further: not a list"), ([3], "further: not a list"),
    ([sample(Percept)] * 33, "further: not a list of at")])
def test_what_is_listed_is_checked_before_it_is_said(further, complaint):
    with pytest.raises(MessageError, match=complaint):
        encode(sample(Percept, further=further))


@pytest.mark.parametrize(("change", "complaint"), [
    ({"presence": float("nan")}, "presence: not a finite number"), ({"type": "Belief"}, "type: not a Percept"),
    ({"version": 1}, "version: 1, not"), ({"odd": 1}, "odd: unknown field"),
    ({"further": [{"a": 1}]}, "further: a list")])
def test_what_is_listed_is_checked_when_it_is_heard(change, complaint):
    """A map in a list is as little trusted as the one around it, and holds no lists of maps itself."""
    fields = msgpack.unpackb(encode(sample(Percept, further=[sample(Percept)])))
    fields["further"][0] |= change
    with pytest.raises(MessageError, match=complaint):
        decode(Percept, msgpack.packb(fields))
