"""Both buses deliver everything, in order and to whom it may concern; what goes wrong is said in one line."""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
from contextlib import closing, suppress

import pytest

from saccade.shared.bus.topics import ACTION, FRAME, PERCEPT, RESULT
from saccade.shared.bus.transport import LocalBus, ZenohBus, free_endpoint
from saccade.shared.errors import SaccadeError

WAIT_S = 20  # for what must come; nothing is asserted about how long it takes


class Pair:
    """Two ends of one bus."""

    def __init__(self, kind: str) -> None:
        if kind == "local":
            self.a = self.b = LocalBus()
        else:
            endpoint = free_endpoint("tcp/127.0.0.1:0")
            self.router = ZenohBus(endpoint, world="test", listen=True)
            self.a, self.b = (ZenohBus(endpoint, world="test") for _ in range(2))

    def link(self, topics, *, probe=ACTION) -> queue.SimpleQueue:
        """What `b` hears of `topics`, once it is known to hear."""
        arrived = queue.SimpleQueue()
        self.b.subscribe(topics, lambda *item: arrived.put(item))
        for _ in range(200):
            self.a.publish(probe, "probe" if probe.parts else None, b"probe")
            try:
                arrived.get(timeout=0.1)
                break
            except queue.Empty:
                continue
        self.a.publish(probe, "probe" if probe.parts else None, b"end")
        while arrived.get(timeout=WAIT_S)[2] != b"end":
            pass
        return arrived

    def close(self) -> None:
        for bus in {self.a, self.b, getattr(self, "router", self.a)}:
            bus.close()


@pytest.fixture(params=["local", "zenoh"])
def pair(request):
    with closing(Pair(request.param)) as ends:
        yield ends


def test_delivers_topic_part_and_bytes(pair):
    arrived = pair.link([ACTION, PERCEPT])
    pair.a.publish(FRAME, None, b"not subscribed")
    pair.a.publish(PERCEPT, "mug", b"\x00\xff" * 5)
    assert arrived.get(timeout=WAIT_S) == (PERCEPT, "mug", b"\x00\xff" * 5)
    pair.a.publish(ACTION, None, b"")
    assert arrived.get(timeout=WAIT_S) == (ACTION, None, b"")


def test_all_topics_arrive_in_order_of_publication(pair):
    arrived = pair.link(None)
    sent = [(topic, part, str(i).encode() * (1 + 5000 * (i % 3)))
            for i in range(100) for topic, part in ((FRAME, None), (PERCEPT, "mug"), (PERCEPT, "can"), (RESULT, None))]
    for item in sent:
        pair.a.publish(*item)
    assert [arrived.get(timeout=WAIT_S) for _ in sent] == sent


def test_two_hundred_big_messages_all_arrive(pair):
    arrived = pair.link([FRAME], probe=FRAME)
    for i in range(200):
        pair.a.publish(FRAME, None, i.to_bytes(2) + bytes(921_600))
    payloads = [arrived.get(timeout=WAIT_S)[2] for _ in range(200)]
    assert [int.from_bytes(p[:2]) for p in payloads] == list(range(200))
    assert {len(p) for p in payloads} == {921_602}


def test_worlds_do_not_hear_each_other():
    with closing(Pair("zenoh")) as pair:
        arrived = pair.link([ACTION])
        with closing(ZenohBus(pair.router.endpoint, world="other")) as other:
            other.publish(ACTION, None, b"from another world")
            pair.a.publish(ACTION, None, b"from ours")
            assert arrived.get(timeout=WAIT_S)[2] == b"from ours"


def test_keys_that_are_no_topics_are_ignored():
    with closing(Pair("zenoh")) as pair:
        arrived = pair.link(None)
        for key in ("saccade/test/nonsense", "saccade/test/percept", "saccade/test/frame/extra/deep"):
            pair.a._session.put(key, b"noise")
        pair.a.publish(ACTION, None, b"after")
        assert arrived.get(timeout=WAIT_S)[2] == b"after"


def test_port_in_use_is_one_line_that_says_what_to_do():
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    with closing(ZenohBus(endpoint, world="test", listen=True)):
        with pytest.raises(SaccadeError, match="in use; choose another") as caught:
            ZenohBus(endpoint, world="test", listen=True)
        assert endpoint in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_bus_that_does_not_answer_is_named():
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    with pytest.raises(SaccadeError, match=f"{endpoint} does not answer"):
        ZenohBus(endpoint, world="test", timeout_s=0.5)


@pytest.mark.parametrize("endpoint", ["nonsense", "", "carrier-pigeon/roof:1"])
def test_a_malformed_endpoint_is_refused(endpoint):
    with pytest.raises(SaccadeError):
        ZenohBus(endpoint, world="test", timeout_s=0.5)


def test_port_zero_is_for_the_launcher():
    with pytest.raises(SaccadeError, match="launcher"):
        ZenohBus("tcp/127.0.0.1:0", world="test")
    assert free_endpoint("tcp/127.0.0.1:7447") == "tcp/127.0.0.1:7447"
    assert not free_endpoint("tcp/127.0.0.1:0").endswith(":0")


def test_closing_twice_and_publishing_afterwards_is_harmless(pair):
    pair.a.close()
    pair.a.close()
    pair.a.publish(ACTION, None, b"too late")


LOOKS_ON = """
import sys, time
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.bus.topics import FRAME
bus = ZenohBus(sys.argv[1], world="test", onlooker=True)
bus.subscribe((FRAME,), lambda *item: None)
bus.join("there", "it", lambda members: None)
time.sleep(600)
"""


def test_one_who_looks_on_and_is_suspended_holds_nobody_up():
    """Its share is dropped; the others get everything. Of a service that takes nothing the router would let go after
    some seconds of waiting: this one is still there."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    payload, count = bytes(480 * 480 * 3), 300  # more than is held on the way
    looking = subprocess.Popen([sys.executable, "-c", LOOKS_ON, endpoint])
    try:
        with (closing(ZenohBus(endpoint, world="test", listen=True)), closing(ZenohBus(endpoint, world="test")) as bus,
              closing(ZenohBus(endpoint, world="test")) as other):
            met, arrived = queue.SimpleQueue(), queue.SimpleQueue()
            bus.join("there", "me", met.put)
            other.subscribe((FRAME,), lambda topic, *_: arrived.put(topic))
            other.join("there", "other", lambda members: None)
            while not {"it", "other"} <= (members := met.get(timeout=WAIT_S)):
                pass
            looking.send_signal(signal.SIGSTOP)
            for _ in range(count):
                bus.publish(FRAME, None, payload)
            assert [arrived.get(timeout=WAIT_S) for _ in range(count)] == [FRAME] * count
            with suppress(queue.Empty):
                while True:
                    members = met.get(timeout=1.0)
            looking.kill()
            assert "it" in members
    finally:
        looking.kill()
        looking.wait()
