"""Compares the messages of a replay with the recorded ones, field by field, while both come in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saccade.app.replay.tolerances import IGNORED, tolerance_of
from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import MessageError, decode, stamp_of
from saccade.shared.errors import printable
from saccade.shared.log.migrations import ADDED

KEPT = 1_000  # at most so many differences are kept

At = tuple[str, str | None, int, int]  # topic, part, episode, step


@dataclass(frozen=True)
class Difference:
    """One field of one message that differs from the recording. `size` is the largest |replayed - recorded| of its
    numbers. For packed bits it is the share of bits that differ. It is infinite where there is no such number."""

    topic: str
    part: str | None
    episode: int
    step: int
    field: str
    recorded: str
    replayed: str
    size: float
    tolerated: bool

    def __str__(self) -> str:
        where = f"{self.topic}{f'/{self.part}' if self.part else ''} episode {self.episode} step {self.step}"
        return printable(f"{where}: {self.field}: recorded {self.recorded}, replayed {self.replayed}")


@dataclass
class Comparison:
    """Takes messages of the recording and of the replay in any order. A pair is compared when both messages are there.
    Only messages that still wait for the other one are kept in memory."""

    compared: int = 0
    unequal: int = 0  # pairs that differ in a byte
    beyond: int = 0  # pairs that differ beyond what is tolerated
    differences: list[Difference] = field(default_factory=list)
    topics: set[str] = field(default_factory=set)  # of which the recording has messages
    not_compared: list[At] = field(default_factory=list)  # of steps of which a damaged log lacks a part
    # Called with topic, part, recorded and replayed message of every pair
    on_pair: Callable[[Topic, str | None, Message, Message], None] | None = None
    _recorded: dict[At, tuple[Topic, bytes]] = field(default_factory=dict)
    _replayed: dict[At, tuple[Topic, bytes]] = field(default_factory=dict)

    def recorded(self, topic: Topic, part: str | None, payload: bytes) -> list[Difference]:
        """Takes the wire bytes of a recorded message. Returns the differences if the replayed one is there, else
        none."""
        self.topics.add(topic.name)
        return self._take(self._recorded, self._replayed, topic, part, payload)

    def replayed(self, topic: Topic, part: str | None, payload: bytes) -> list[Difference]:
        """Takes the wire bytes of a replayed message. Returns the differences if the recorded one is there, else
        none."""
        return self._take(self._replayed, self._recorded, topic, part, payload)

    @property
    def equal(self) -> bool:
        """Whether something was compared, nothing differs beyond what is tolerated, and no message is on one side
        alone."""
        return self.compared > 0 and not (self.beyond or self._recorded or self._replayed)

    @property
    def only_recorded(self) -> list[At]:
        """The messages that the replay did not produce."""
        return sorted(self._recorded, key=str)

    @property
    def only_replayed(self) -> list[At]:
        """The messages that the recording does not have."""
        return sorted(self._replayed, key=str)

    def set_aside(self, may_lack: Callable[[Topic, str | None, int, int], bool]) -> None:
        """Moves what was said only now to `not_compared`, where the recording may have lost its twin."""
        for at, (topic, _) in list(self._replayed.items()):
            if may_lack(topic, *at[1:]):
                del self._replayed[at]
                self.not_compared.append(at)

    def _take(self, own: dict, other: dict, topic: Topic, part: str | None, payload: bytes) -> list[Difference]:
        stamp = stamp_of(payload)
        at = (topic.name, part, stamp.episode, stamp.step)
        if at not in other:
            own[at] = (topic, payload)
            return []
        twin = other.pop(at)[1]
        self.compared += 1
        if twin == payload and self.on_pair is None:
            return []
        new, old = (twin, payload) if own is self._recorded else (payload, twin)
        replayed = decode(topic.type, new)
        try:
            recorded = decode(topic.type, old)
        except MessageError as error:
            self.unequal, self.beyond = self.unequal + 1, self.beyond + 1
            invalid = Difference(*at, "message", str(error), "a valid message", float("inf"), tolerated=False)
            self.differences += [invalid][:KEPT - len(self.differences)]
            return [invalid]
        if self.on_pair is not None:
            self.on_pair(topic, part, recorded, replayed)
        if twin == payload:
            return []
        found = list(differences(topic, part, recorded, replayed))
        self.unequal += 1
        self.beyond += any(not difference.tolerated for difference in found)
        self.differences += found[:KEPT - len(self.differences)]
        return found


def differences(topic: Topic, part: str | None, recorded: Message, replayed: Message) -> Iterator[Difference]:
    """Yields the fields in which two messages differ, tolerated or not."""
    for entry in dataclasses.fields(recorded):
        old, new = getattr(recorded, entry.name), getattr(replayed, entry.name)
        if entry.name in IGNORED or (not _lists_messages(old, new) and np.array_equal(old, new)):
            continue
        if _lists_messages(old, new) and len(old) == len(new):
            for n, pair in enumerate(zip(old, new, strict=True)):
                yield from (dataclasses.replace(found, field=f"{entry.name}[{n}].{found.field}")
                            for found in differences(topic, part, *pair))
            continue
        if old is None and entry.name in ADDED.get(type(recorded), ()):  # the recording's format did not have it
            continue
        size, tolerated = _size(topic.name, entry.name, old, new)
        yield Difference(topic.name, part, recorded.episode, recorded.step, entry.name, *_texts(old, new), size,
                         tolerated)


def _lists_messages(*values: Any) -> bool:
    return any(isinstance(value, list) and value and isinstance(value[0], Message) for value in values)


def _size(topic: str, name: str, old: Any, new: Any) -> tuple[float, bool]:
    """Returns how far two values are apart, and whether that is tolerated."""
    if any(isinstance(v, (str, bool, list, type(None))) for v in (old, new)) or np.shape(old) != np.shape(new):
        return float("inf"), False
    allowed = tolerance_of(topic, name)
    if allowed.flipped is not None:
        share = float(np.unpackbits(old ^ new).mean())
        return share, share <= allowed.flipped
    if allowed.spread is not None:
        moments = [np.array([points.mean(0), points.std(0)], np.float64) for points in (old, new)]
        off = np.abs(moments[1] - moments[0])
        return float(off.max()), bool((off <= allowed.absolute + allowed.spread * moments[0][1]).all())
    apart = np.abs(np.asarray(new, np.float64) - np.asarray(old, np.float64))
    within = apart <= allowed.absolute + allowed.relative * np.abs(np.asarray(old, np.float64))
    return float(apart.max(initial=0.0)), bool(within.all())


def _texts(old: Any, new: Any) -> tuple[str, str]:
    """Returns both values as text. For arrays these are the numbers that are furthest apart, with their index."""
    if not (isinstance(old, np.ndarray) and isinstance(new, np.ndarray)):
        return _text(old), _text(new)
    if old.shape != new.shape:
        return f"shape {list(old.shape)}", f"shape {list(new.shape)}"
    place = np.unravel_index(np.argmax(np.abs(new.astype(np.float64) - old.astype(np.float64))), old.shape)
    index = f"[{', '.join(str(i) for i in place)}]"
    return f"{index} {_text(old[place])}", f"{index} {_text(new[place])}"


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    if _lists_messages(value):
        return f"{len(value)} messages"
    return f"{value:.9g}" if isinstance(value, (float, np.floating)) else str(value)
