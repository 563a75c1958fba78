"""`python -m saccade.benchmarks.fuzz [PAYLOADS [SEED [out.json]]]`: payloads that are no good, over all topics. Each is
decoded, its stamp is read and it is migrated as a log's would be: nothing but MessageError may be raised, its text must
be short and printable, and a payload that passes must encode again. The exit code is 1 if anything else happened.

Valid messages are mutated on three levels: their bytes, their MessagePack tree, and their fields.
"""

from __future__ import annotations

import json
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack

from saccade.shared.bus.topics import TOPICS, Topic
from saccade.shared.bus.wire import MAX_REASON, MessageError, decode, encode, stamp_of
from saccade.shared.log.migrations import FORMAT, OLDEST, Migration
from saccade.shared.log.provenance import commit
from saccade.tests.samples import sample

EVERY = 50_000  # payloads, after which progress is told
WORDS = ("", "x", "\x1b[2J", "\u202e", "type", "version", "run", "x" * 5000, "\x00", "Status", "__class__")
NUMBERS = (0, 1, -1, 2 ** 31, 2 ** 62, 2 ** 63, 2 ** 64 - 1, -2 ** 63, 1e308, -1e308, 1e-320, float("nan"),
           float("inf"))
HEADERS: tuple[Any, ...] = (["f8", [2]], ["f8", [2 ** 40]], ["f4", [-1]], ["O", [1]], ["f8", "2"], ["f8", [[2]]],
           ["f8"], {}, ["u1", [0] * 9], ["f8", [2.0]], [b"f8", [2]], [["f8"], [2]], ["f8", [None]], ["<f8", [2]])


def _value(rng: random.Random, depth: int = 0) -> Any:
    """Anything that MessagePack can say."""
    kind = rng.randrange(10 if depth < 4 else 6)
    if kind == 0:
        return rng.choice(NUMBERS)
    if kind == 1:
        return rng.choice(WORDS)
    if kind == 2:
        return rng.choice((None, True, False))
    if kind == 3:
        return rng.randbytes(rng.choice((0, 1, 16, 300)))
    if kind == 4:
        return _array(rng)
    if kind == 5:
        return msgpack.ExtType(rng.randrange(128), rng.randbytes(rng.randrange(40)))
    if kind == 6:
        return {_key(rng): _value(rng, depth + 1) for _ in range(rng.randrange(4))}
    if kind == 7:
        return [_value(rng, depth + 1) for _ in range(rng.choice((0, 1, 3, 300 if depth == 0 else 2)))]
    nested: Any = None
    for _ in range(rng.choice((5, 100, 400))):
        nested = [nested] if kind == 8 else {"a": nested}
    return nested


def _key(rng: random.Random) -> Any:
    return rng.choice((*WORDS, b"x", 1, 1.5, None, True))


def _array(rng: random.Random) -> msgpack.ExtType:
    """An array whose header may lie."""
    return msgpack.ExtType(1, msgpack.packb(rng.choice(HEADERS)) + rng.randbytes(rng.choice((0, 7, 8, 16, 200))))


def in_bytes(payload: bytes, rng: random.Random) -> bytes:
    """Bits flipped, bytes removed, doubled, exchanged or put in; cut; heads of great sizes."""
    data = bytearray(payload)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        at, how = rng.randrange(len(data) + 1), rng.randrange(7)
        if how == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif how == 1:
            del data[at:at + rng.choice((1, 2, 9))]
        elif how == 2:
            data[at:at] = data[at:at + rng.choice((1, 8, 64))]
        elif how == 3:
            data[at:at] = rng.randbytes(rng.choice((1, 4, 30)))
        elif how == 4:
            del data[at:]
        elif how == 5:
            data[at:at] = rng.choice((b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff\x01",
                                      b"\xdb\x7f\xff\xff\xff", b"\x91" * 600, b"\x81\xa1a" * 300, b"\xc1"))
        elif at < len(data):
            data[at] = rng.randrange(256)
    return bytes(data)


def in_tree(payload: bytes, rng: random.Random) -> bytes:
    """Fields with other values, other names, more and fewer of them; or another tree altogether."""
    fields = msgpack.unpackb(payload, strict_map_key=False)
    for _ in range(rng.choice((1, 1, 2, 4))):
        how, name = rng.randrange(5), rng.choice(list(fields) or ["run"])
        if how <= 1:
            fields[name] = _value(rng)
        elif how == 2:
            fields.pop(name, None)
        elif how == 3:
            fields[_key(rng)] = _value(rng)
        else:
            fields[name], other = _value(rng), fields.get(name)
            fields[_key(rng)] = other
    items = list(fields.items())
    if rng.random() < 0.3:
        rng.shuffle(items)
    return _packed(dict(items) if rng.random() < 0.95 else _value(rng))


def at_random(payload: bytes, rng: random.Random) -> bytes:
    """Bytes that have nothing to do with a message."""
    return rng.choice((rng.randbytes(rng.randrange(600)), _packed(_value(rng))))


def _packed(tree: Any) -> bytes:
    try:
        return msgpack.packb(tree)
    except (ValueError, OverflowError, TypeError, RecursionError):  # deeper or larger than msgpack itself writes
        return b"\xdd\xff\xff\xff\xff"


WAYS: tuple[Callable[[bytes, random.Random], bytes], ...] = (in_bytes, in_tree, at_random)


def trial(topic: Topic, payload: bytes, migrate: Migration) -> str:
    """What came of a payload: "refused", "passed", or what went wrong."""
    outcome = "passed"
    for what in (lambda: decode(topic.type, payload), lambda: stamp_of(payload),
                 lambda: decode(topic.type, migrate(topic, None, payload))):
        try:
            message = what()
            if isinstance(message, topic.type):
                encode(message)
        except MessageError as error:
            outcome = "refused"
            if not str(error).isprintable() or len(str(error)) > MAX_REASON + 10:
                return f"a text that is no text: {str(error)!r:.100}"
        except BaseException as error:
            return f"{type(error).__name__}: {str(error)[:100]}"
    return outcome


def fuzz(payloads: int, seed: int) -> dict[str, Any]:
    """So many payloads of a seed, over all topics and ways; what came of them."""
    rng, outcomes = random.Random(seed), Counter[str]()
    wrong: list[dict[str, str]] = []
    valid = {topic: encode(sample(topic.type)) for topic in TOPICS.values()}
    migrations = [Migration(number, Path("fuzz.mcap")) for number in range(OLDEST, FORMAT + 1)]
    start_s = time.monotonic()
    for number in range(payloads):
        topic, way = rng.choice(list(valid)), rng.choices(WAYS, (5, 5, 1))[0]
        payload = way(valid[topic], rng)
        outcome = trial(topic, payload, rng.choice(migrations))
        outcomes[outcome if outcome in ("passed", "refused") else "wrong"] += 1
        if outcome not in ("passed", "refused") and len(wrong) < 20:
            wrong.append({"topic": topic.name, "outcome": outcome, "payload": payload[:500].hex()})
        if (number + 1) % EVERY == 0:
            print(f"{number + 1} payloads: {dict(outcomes)}", flush=True)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return {"commit": commit(), "seed": seed, "payloads": payloads, "outcomes": dict(outcomes), "wrong": wrong,
            "peak_mb": peak_mb, "seconds": round(time.monotonic() - start_s)}


def main(arguments: list[str]) -> int:
    """The command."""
    payloads, seed = (int(arguments[k]) if len(arguments) > k else default for k, default in ((0, 1_000_000), (1, 0)))
    result = fuzz(payloads, seed)
    text = json.dumps(result, indent=1)
    print(text)
    if len(arguments) > 2:
        Path(arguments[2]).write_text(text + "\n")
    return int(bool(result["wrong"]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
