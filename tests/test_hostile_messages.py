"""Payloads that mean harm: refused whatever they are, in few words, before anything is built of them."""

from __future__ import annotations

import functools
import tracemalloc

import msgpack
import numpy as np
import pytest

from saccade.benchmarks.fuzz import WAYS, fuzz
from saccade.shared.bus.messages import Frame, Status
from saccade.shared.bus.topics import TOPICS
from saccade.shared.bus.wire import MAX_BYTES, MAX_REASON, MessageError, decode, encode, scan, stamp_of
from saccade.tests.samples import sample

ARRAY_AS_TYPE = msgpack.ExtType(1, msgpack.packb(["f8", [2]]) + bytes(16))
MAPS = msgpack.packb({"type": "Status", "version": 1, "run": {}})
NASTY = {
    "bytes as keys": msgpack.packb({"type": "Status", "version": 1, b"x": 1, "y": 2}),
    "an array as type": msgpack.packb({"type": ARRAY_AS_TYPE}),
    "a deep version": b"\x82\xa4type\xa6Status\xa7version" + b"\x91" * 1000 + b"\xc0",
    "a deep map": b"\x81\xa4type" + b"\x81\xa1a" * 1000 + b"\xc0",
    "control codes as a name": msgpack.packb({"\x1b[2J\x07": 1}),
    "a name of 10 kB": msgpack.packb({"x" * 10_000: 1}),
    "a field twice": b"\x82\xa4type\xa6Status\xa4type\xa6Status",
    "a map with more fields than bytes": b"\xdf\xff\xff\xff\xff",
    "a list with more texts than bytes": b"\x81\xa4type\xdd\xff\xff\xff\xff",
    "a text longer than the payload": b"\x81\xa4type\xdb\x7f\xff\xff\xff",
    "an array longer than the payload": b"\x81\xa4type\xc9\x7f\xff\xff\xff\x01",
    "nothing": b"",
    "what is no MessagePack": b"\xc1",
    "a version of text": msgpack.packb({"type": "Status", "version": "1"}),
    "no Unicode": b"\x81\xa4type\xa2\xed\xa0",
    "maps within": MAPS,
}


@pytest.mark.parametrize("name", NASTY)
def test_whatever_the_bytes_it_is_refused_in_a_few_printable_words(name):
    readers = [functools.partial(decode, topic.type) for topic in TOPICS.values()]
    for read in (*readers, stamp_of):
        with pytest.raises(MessageError) as caught:
            read(NASTY[name])
        assert str(caught.value).isprintable()
        assert 0 < len(str(caught.value)) <= MAX_REASON + 4


@pytest.mark.parametrize("filling", [b"\x91", b"\x81\xa1a", b"\x90", b"\x93\xc0\xc0\xc0", b"\xa1a", b"\xc4\x00"])
def test_a_flood_of_containers_is_refused_before_anything_is_built(filling):
    payload = b"\x81\xa3rgb\xdd\x00\xff\xff\xff" + filling * (17 * 1024 * 1024 // len(filling))
    for kind in (Frame, Status):
        tracemalloc.start()
        with pytest.raises(MessageError):
            decode(kind, payload)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1_000_000


def test_a_message_without_an_image_is_small():
    payload = encode(sample(Status, note="x" * 4000))
    assert scan(payload) == len(msgpack.unpackb(payload))
    with pytest.raises(MessageError, match="more than 1048576"):
        decode(Status, payload + bytes(1024 * 1024))
    assert len(encode(sample(Frame, rgb=np.zeros((480, 480, 3), np.uint8), depth_m=None))) < MAX_BYTES


@pytest.mark.parametrize(("changes", "words"), [
    ({"note": "x" * 4097}, "note: a text of 4097 bytes"), ({"note": "\udc80"}, "note: a text that is no Unicode"),
    ({"note": "ä" * 2049}, "note: a text of 4098 bytes")])
def test_what_others_must_refuse_cannot_be_said(changes, words):
    with pytest.raises(MessageError, match=words):
        encode(sample(Status, **changes))


@pytest.mark.parametrize("stamp", [{"seq": 2 ** 64 - 1}, {"step": -1}, {"episode": 2 ** 63}, {"run": 1}, {"run": None}])
def test_a_stamp_has_a_run_and_numbers(stamp):
    fields = {"type": "Status", "version": 1, "run": "r", "episode": 0, "step": 0, "seq": 0} | stamp
    with pytest.raises(MessageError, match="stamp"):
        stamp_of(msgpack.packb(fields))


@pytest.mark.parametrize("seed", [7, 8])
def test_a_little_fuzzing_raises_nothing_else(seed):
    """`python -m saccade.benchmarks.fuzz` does a million."""
    result = fuzz(4000, seed)
    assert result["wrong"] == []
    assert result["outcomes"]["refused"] > 2000
    assert len(WAYS) == 3
