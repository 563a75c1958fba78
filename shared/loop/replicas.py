"""Who else does the same work on this bus, and which objects each of them answers for.

Replicas of a service share the run's objects by rendezvous hashing: all who know the same members come to the same
shares, and one that joins or dies moves few objects.
"""

from __future__ import annotations

import hashlib
import time
import uuid
from collections.abc import Callable, Iterable

from saccade.shared.bus.messages import Message
from saccade.shared.bus.sequences import Episode, Key
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.transport import Bus
from saccade.shared.bus.wire import Stamp
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Service

MEET_S = 0.1  # after so long one that has joined knows who else is there
JOIN_S = 0.5  # one that has joined lets the others finish what they have begun


def shares(parts: Iterable[str], members: Iterable[str]) -> dict[str, str]:
    """For each part the member that answers for it: the one that scores highest for it, of those that have room. Shares
    differ by one at most."""
    parts, members = list(parts), sorted(members)
    least, more = divmod(len(parts), len(members))
    held, owners = dict.fromkeys(members, 0), {}
    for part in parts:
        full = least if sum(count > least for count in held.values()) == more else least + 1
        owners[part] = max((member for member in members if held[member] < full), key=lambda m: _score(part, m))
        held[owners[part]] += 1
    return owners


def alone_on(bus: Bus, name: str) -> None:
    """Says on the bus that this is the world's service of that name, of which there can be one only. Raises
    SaccadeError where another one was there before."""
    me = f"{time.time_ns():020d}-{uuid.uuid4().hex}"
    others: set[str] = set()
    bus.join(name, me, others.update)
    time.sleep(MEET_S)
    if min({me, *others}) != me:
        raise SaccadeError(f"another {name} is in this world already, and a world has one: stop it, or choose another "
                           "world (bus.world)")


def _score(part: str, member: str) -> bytes:
    return hashlib.sha256(f"{part} {member}".encode()).digest()


class Share:
    """What one replica answers for, and what was answered already, by it or by others.

    In lockstep the next step begins only when every object of this one is answered, so at most the last step can lack
    something when a replica dies.
    """

    def __init__(self, service: Service, parts: tuple[str, ...], me: str | None = None) -> None:
        self.me, self._service, self._parts = me or uuid.uuid4().hex, service, parts
        self._members, self._known = frozenset((self.me,)), frozenset((self.me,))
        self._answered: dict[Key, tuple[Episode, set[int]]] = {}  # of each key: the newest episode and its steps

    def met(self, members: frozenset[str]) -> None:
        """Who is there now, maybe without this one yet; from the bus's thread."""
        self._known = members | {self.me}

    def meet(self, bus: Bus, wake: Callable[[], None]) -> None:
        """Says on the bus that this one is there; calls `wake`, from the bus's thread, when another comes or goes."""
        def met(members: frozenset[str]) -> None:
            self.met(members)
            wake()

        bus.join(self._service.name, self.me, met)

    @property
    def changed(self) -> bool:
        """Whether others have come or gone since `take_mine`."""
        return self._known != self._members

    def take_mine(self) -> tuple[str, ...]:
        """The parts of this replica as things are now, in the order of the run's."""
        self._members = self._known
        owners = shares(self._parts, self._members)
        return tuple(part for part in self._parts if owners[part] == self.me)

    def answered(self, topic: Topic, part: str | None, stamp: Stamp | Message) -> None:
        """A message of this service was published."""
        episode, key = (stamp.run, stamp.episode), (topic.name, part)
        known = self._answered.get(key)
        if known is None or known[0][0] != stamp.run or known[0] < episode:
            known = self._answered[key] = episode, set()
        if known[0] == episode:
            known[1].add(stamp.step)

    def is_answered(self, topic: Topic, part: str | None, stamp: Stamp | Message) -> bool:
        """Whether someone has published this message."""
        return self._has(topic, part, (stamp.run, stamp.episode, stamp.step))

    def lacks(self, mine: Iterable[str], at: tuple[str, int, int]) -> bool:
        """Whether any of these parts is still to be answered for a step."""
        return any(not self._has(topic, part, (*at[:2], 0) if topic.latched else at)
                   for topic in self._service.outputs for part in mine)

    def _has(self, topic: Topic, part: str | None, at: tuple[str, int, int]) -> bool:
        episode, steps = self._answered.get((topic.name, part), (None, ()))
        return episode == at[:2] and at[2] in steps
