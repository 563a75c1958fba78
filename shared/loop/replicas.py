"""Knows which replicas of a service are on the bus, and which objects each of them answers for.

Replicas share the objects of the run by rendezvous hashing. All replicas that know the same members compute the same
shares, and few objects change hands when a member joins or dies.
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

MEET_S = 0.1  # after this time a replica that has joined knows the others
JOIN_S = 0.5  # a replica that has joined waits this long, so that the others finish what they began


def shares(parts: Iterable[str], members: Iterable[str]) -> dict[str, str]:
    """Returns, for each part, the member that answers for it. This is the member with the highest score for the part
    among those that have room. The numbers of parts differ by one at most between members."""
    parts, members = list(parts), sorted(members)
    least, more = divmod(len(parts), len(members))
    held, owners = dict.fromkeys(members, 0), {}
    for part in parts:
        full = least if sum(count > least for count in held.values()) == more else least + 1
        owners[part] = max((member for member in members if held[member] < full), key=lambda m: _score(part, m))
        held[owners[part]] += 1
    return owners


def alone_on(bus: Bus, name: str) -> None:
    """Announces on the bus that this is the service of that name, of which a world can have only one. Raises
    SaccadeError if another one was there before."""
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
    """What one replica answers for, and what was already answered by any replica.

    In lockstep the next step begins only when every object of the present one is answered. So when a replica dies, at
    most the last step can lack an answer.
    """

    def __init__(self, service: Service, parts: tuple[str, ...], me: str | None = None) -> None:
        self.me, self._service, self._parts = me or uuid.uuid4().hex, service, parts
        self._members, self._known = frozenset((self.me,)), frozenset((self.me,))
        self._answered: dict[Key, tuple[Episode, set[int]]] = {}  # of each key: the newest episode and its steps

    def met(self, members: frozenset[str]) -> None:
        """Takes the present members, maybe without this one yet. It is called on the bus's thread."""
        self._known = members | {self.me}

    def meet(self, bus: Bus, wake: Callable[[], None]) -> None:
        """Announces this replica on the bus. Calls `wake` on the bus's thread whenever another replica comes or
        goes."""
        def met(members: frozenset[str]) -> None:
            self.met(members)
            wake()

        bus.join(self._service.name, self.me, met)

    @property
    def changed(self) -> bool:
        """Whether other replicas have come or gone since `take_mine`."""
        return self._known != self._members

    def take_mine(self) -> tuple[str, ...]:
        """Returns the parts that this replica now answers for, in the order of the run's parts."""
        self._members = self._known
        owners = shares(self._parts, self._members)
        return tuple(part for part in self._parts if owners[part] == self.me)

    def answered(self, topic: Topic, part: str | None, stamp: Stamp | Message) -> None:
        """Notes that a message of this service was published."""
        episode, key = (stamp.run, stamp.episode), (topic.name, part)
        known = self._answered.get(key)
        if known is None or known[0][0] != stamp.run or known[0] < episode:
            known = self._answered[key] = episode, set()
        if known[0] == episode:
            known[1].add(stamp.step)

    def is_answered(self, topic: Topic, part: str | None, stamp: Stamp | Message) -> bool:
        """Whether a replica has published this message."""
        return self._has(topic, part, (stamp.run, stamp.episode, stamp.step))

    def lacks(self, mine: Iterable[str], at: tuple[str, int, int]) -> bool:
        """Whether any of these parts (`mine`) has no answer yet for the step `at` (run, episode, step)."""
        return any(not self._has(topic, part, (*at[:2], 0) if topic.latched else at)
                   for topic in self._service.outputs for part in mine)

    def _has(self, topic: Topic, part: str | None, at: tuple[str, int, int]) -> bool:
        episode, steps = self._answered.get((topic.name, part), (None, ()))
        return episode == at[:2] and at[2] in steps
