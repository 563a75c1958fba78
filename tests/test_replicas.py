"""Replicas of a service: each object is answered once a step, whoever comes, goes or dies."""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import suppress

import pytest

from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.topics import FRAME, GOAL, GOAL_PERCEPT, PERCEPT, Output
from saccade.shared.bus.transport import LocalBus
from saccade.shared.bus.wire import MessageError, decode, encode, stamp_of
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.main import serve
from saccade.shared.loop.process import Inbox
from saccade.shared.loop.replicas import Share, alone_on, shares
from saccade.shared.loop.service import Service
from saccade.tests.samples import sample

PARTS = ("cup", "jar", "jug", "mug", "pot")
SERVICE = Service("divided", inputs=(FRAME, GOAL), trigger=FRAME, outputs=(PERCEPT, GOAL_PERCEPT), divisible=True)
WAIT_S = 10


@pytest.mark.parametrize("members", [1, 2, 3, 4, 5, 8])
def test_every_object_has_one_owner_and_shares_are_even(members):
    names = [f"replica {k}" for k in range(members)]
    owners = shares(PARTS, names)
    counts = Counter(owners.values())
    assert list(owners) == list(PARTS)
    assert max(counts.values()) - min(counts.get(name, 0) for name in names) <= 1
    assert shares(PARTS, reversed(names)) == owners


def test_one_that_dies_leaves_most_objects_where_they_were():
    parts, names = [f"object {k}" for k in range(60)], [f"replica {k}" for k in range(6)]
    before, after = shares(parts, names), shares(parts, names[1:])
    moved = [part for part in parts if before[part] != names[0] and before[part] != after[part]]
    assert len(moved) < 0.25 * len(parts)  # by remainders of a division it would be three quarters


def test_what_another_has_answered_is_answered():
    share, message = Share(SERVICE, PARTS, "a"), at(PERCEPT, 4, object="cup")
    assert not share.is_answered(PERCEPT, "cup", message)
    share.answered(PERCEPT, "cup", stamp_of(encode(message)))
    assert share.is_answered(PERCEPT, "cup", message)
    assert not share.is_answered(PERCEPT, "cup", at(PERCEPT, 3, object="cup"))
    assert share.lacks(["cup"], ("r", 0, 4))  # the goal's is still to come
    share.answered(GOAL_PERCEPT, "cup", at(PERCEPT, object="cup"))
    assert not share.lacks(["cup"], ("r", 0, 4))
    assert share.lacks(["cup"], ("r", 1, 4))


def at(topic, step=0, **values):
    return sample(topic.type, run="r", episode=0, step=step, seq=step, **values)


class Core:
    """Answers for its objects, and holds on at a step if told to."""

    def __init__(self):
        self.names, self.hold = PARTS, threading.Event()
        self.hold.set()

    def share(self, names):
        self.names, self.goal_told = names, False

    def begin(self, run, episode):
        self.goal_told = False
        return ()

    def step(self, inputs):
        self.hold.wait(WAIT_S)
        frame = inputs["frame"]
        for name in self.names:
            if not self.goal_told:
                yield Output(GOAL_PERCEPT, at(PERCEPT, object=name), name)
            yield Output(PERCEPT, at(PERCEPT, frame.step, object=name), name)
        self.goal_told = True


class Replica:
    """One on a bus, in a thread of its own."""

    def __init__(self, bus):
        self.bus, self.core, self.inbox = bus, Core(), Inbox()
        before = set(bus.members("divided"))
        self.thread = threading.Thread(target=serve, args=(SERVICE, self.core, bus, PARTS),
                                       kwargs={"run": "r", "inbox": self.inbox}, daemon=True)
        self.thread.start()
        until(lambda: set(bus.members("divided")) - before)
        self.me, = set(bus.members("divided")) - before

    def die(self):
        """As a killed process does: nothing it still had to say is said."""
        self.bus.mute.add(self.thread)
        self.bus.leave("divided", self.me)
        self.inbox.stop()


class Bus(LocalBus):
    """One on which threads can fall silent."""

    def __init__(self):
        super().__init__()
        self.mute = set()

    def publish(self, topic, part, payload):
        if threading.current_thread() not in self.mute:
            super().publish(topic, part, payload)


def until(condition):
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.002)


@pytest.fixture
def bus():
    bus = Bus()
    bus.seen = []

    def see(topic, part, payload):
        with suppress(MessageError):
            bus.seen.append((topic.name, part, decode(topic.type, payload)))

    bus.subscribe([PERCEPT, GOAL_PERCEPT], see)
    outbox = Outbox()
    bus.answer([FRAME, GOAL], outbox.answer)

    def publish(topic, message):
        outbox.keep(topic, None, message, encode(message))
        bus.publish(topic, None, encode(message))

    bus.show = lambda step: publish(FRAME, at(FRAME, step))
    bus.publish_goal = lambda: publish(GOAL, at(GOAL))
    yield bus
    bus.close()


def answers(bus, step):
    return Counter(part for topic, part, message in bus.seen if topic == "percept" and message.step == step)


def once(bus, step):
    until(lambda: len(answers(bus, step)) == len(PARTS))
    time.sleep(0.05)
    assert answers(bus, step) == Counter(PARTS)


def test_each_object_is_answered_once_by_any_number_who_come_and_die(bus):
    first, second = Replica(bus), Replica(bus)
    until(lambda: sorted((*first.core.names, *second.core.names)) == list(PARTS))
    bus.publish_goal()
    for step in range(3):
        bus.show(step)
        once(bus, step)
    third = Replica(bus)
    until(lambda: {len(r.core.names) for r in (first, second, third)} == {1, 2})
    bus.show(3)
    once(bus, 3)
    second.core.hold.clear()  # it dies while it works on step 4
    bus.show(4)
    until(lambda: len(answers(bus, 4)) == len(PARTS) - len(second.core.names))
    second.die()
    once(bus, 4)
    bus.show(5)
    once(bus, 5)
    numbers = {part: [m.seq for topic, p, m in bus.seen if (topic, p) == ("percept", part)] for part in PARTS}
    assert all(of_one == list(range(6)) for of_one in numbers.values())
    assert Counter(part for topic, part, _ in bus.seen if topic == "goal_percept") == Counter(PARTS)


def test_what_a_dead_one_said_the_others_still_know(bus):
    first, second = Replica(bus), Replica(bus)
    until(lambda: sorted((*first.core.names, *second.core.names)) == list(PARTS))
    bus.publish_goal()
    bus.show(0)
    once(bus, 0)
    second.die()
    kept = {(k.topic.name, k.part) for k in bus.recall([PERCEPT, GOAL_PERCEPT], ("r", 0, 0))}
    assert {part for _, part in kept} == set(PARTS)
    first.inbox.stop()


def test_what_is_no_message_is_no_answer(bus):
    replica = Replica(bus)
    payload = encode(at(PERCEPT, object="cup"))
    for broken in (payload[:-1], payload.replace(b"presence", b"absence!", 1)):
        bus.publish(PERCEPT, "cup", broken)
    bus.seen.clear()
    bus.publish_goal()
    bus.show(0)
    once(bus, 0)
    replica.inbox.stop()


def test_a_second_source_is_refused():
    bus = LocalBus()
    alone_on(bus, "simulator")
    with pytest.raises(SaccadeError, match="another simulator is in this world already"):
        alone_on(bus, "simulator")
