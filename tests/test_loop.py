"""The one main loop: the same bytes over Zenoh, over the local bus and in one process; bad messages change nothing."""

from __future__ import annotations

import json
import queue
import threading
from collections import defaultdict
from contextlib import closing

import msgpack
import numpy as np
import pytest

from saccade.shared.bus.messages import Status
from saccade.shared.bus.topics import (
    ACTION,
    BELIEF,
    FRAME,
    GOAL_PERCEPT,
    PERCEPT,
    PLAN,
    RESULT,
    STATUS,
    TOPICS,
    TRUTH,
    Output,
)
from saccade.shared.bus.transport import LocalBus, ZenohBus, free_endpoint
from saccade.shared.bus.wire import MAX_BYTES, decode, encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.local import run_local
from saccade.shared.loop.main import run_module, serve
from saccade.shared.loop.process import Inbox
from saccade.shared.loop.service import Service
from saccade.tests.fakes.services import SERVICES, module, pairs
from saccade.tests.samples import array_fields, sample

PARTS = ("mug", "can")
CONFIG = Config().with_values({"scene.names": list(PARTS), "scene.count": 2, "simulator.max_steps": 6, "seed": 5})
WAIT_S = 30  # for what must come; nothing is asserted about how long it takes


def by_key(entries) -> dict:
    """Payloads per key, in order; status is about the process and left out."""
    keys = defaultdict(list)
    for topic, part, payload in entries:
        if topic != STATUS:
            keys[topic.name, part].append(payload)
    return dict(keys)


def locally(*, encoded: bool) -> dict:
    seen = []
    run_local(pairs(CONFIG), PARTS, "r", None, lambda t, p, m, payload: seen.append((t, p, payload or encode(m))),
              encoded=encoded)
    return by_key(seen)


class Running:
    """The fake services, each in its thread on its own end of a bus, and a listener."""

    def __init__(self, kind: str, names=tuple(SERVICES), wait_for=("perception", "belief", "planner", "evaluator")):
        self.arrived: queue.SimpleQueue = queue.SimpleQueue()
        self.listener = LocalBus()
        if kind == "zenoh":
            self.listener = ZenohBus(free_endpoint("tcp/127.0.0.1:0"), world="test", listen=True)
        self.listener.subscribe(None, lambda *item: self.arrived.put(item))
        self.kind, self.inboxes, self.threads, self.health = kind, {}, [], {}
        for service, core in pairs(CONFIG):
            if service.name in names:
                self._start(service, core, wait_for)

    def _start(self, service, core, wait_for) -> None:
        inbox = self.inboxes[service.name] = Inbox()

        def run() -> None:
            bus = ZenohBus(self.listener.endpoint, world="test") if self.kind == "zenoh" else self.listener
            self.health[service.name] = serve(service, core, bus, PARTS, run="r",
                                              wait_for=wait_for, inbox=inbox)
            if self.kind == "zenoh":
                bus.close()

        self.threads.append(threading.Thread(target=run, daemon=True))
        self.threads[-1].start()

    def until(self, wanted) -> list:
        """Everything that arrives up to the first entry for which `wanted(topic, part, payload)` holds."""
        seen = []
        while not seen or not wanted(*seen[-1]):
            seen.append(self.arrived.get(timeout=WAIT_S))
        return seen

    def until_status(self, service: str, wanted) -> tuple[list, Status]:
        """As `until`, for a status of that service."""
        seen = self.until(lambda t, p, b: t == STATUS and p == service and wanted(decode(Status, b)))
        return seen, decode(Status, seen[-1][2])

    def close(self) -> None:
        for inbox in self.inboxes.values():
            inbox.stop()
        for thread in self.threads:
            thread.join(WAIT_S)
        assert not any(thread.is_alive() for thread in self.threads)
        self.listener.close()


@pytest.mark.parametrize("kind", ["local", "zenoh"])
def test_bus_and_one_process_give_the_same_bytes(kind):
    with closing(Running(kind)) as running:
        seen = running.until(lambda t, p, b: t == RESULT and decode(t.type, b).episode == CONFIG.scene.count - 1)
    while not running.arrived.empty():
        seen.append(running.arrived.get())
    expected = locally(encoded=True)
    assert by_key(seen) == expected
    assert {name for name, _ in expected} == {name for name, topic in TOPICS.items() if not topic.optional} - {"status"}
    for health in running.health.values():
        assert (health.refused, health.skipped, health.gaps, health.state) == (0, 0, 0, "stopped")


def test_passing_messages_unencoded_changes_no_byte():
    assert locally(encoded=False) == locally(encoded=True)


def test_chosen_episodes_are_those_of_the_whole_run():
    """To the byte; every step of a core is timed under its service's name."""

    def messages(episodes, seen, steps):
        run_local(pairs(CONFIG), PARTS, "r", episodes,
                  lambda t, p, m, _: seen.append((t, p, encode(m))),
                  on_step=lambda service, milliseconds: steps.append((service, milliseconds >= 0)))
        return by_key(e for e in seen if decode(e[0].type, e[2]).episode == 1)

    alone, steps = [], []
    assert messages((1,), alone, steps) == messages(None, [], [])
    assert all(decode(topic.type, payload).episode == 1 for topic, _, payload in alone)
    assert set(steps) == {(name, True) for name in SERVICES}
    assert steps.count(("planner", True)) == CONFIG.simulator.max_steps


def test_sequence_numbers_count_the_messages_of_each_key_in_every_episode():
    for (name, _), payloads in locally(encoded=True).items():
        episodes = defaultdict(list)
        for message in (decode(TOPICS[name].type, payload) for payload in payloads):
            episodes[message.episode].append(message.seq)
        assert len(episodes) == CONFIG.scene.count
        assert all(seqs == list(range(len(seqs))) for seqs in episodes.values())


def nonsense(topic) -> dict[str, bytes]:
    """Payloads that are no message of this topic, by what is wrong with them."""
    good = sample(topic.type)
    fields = msgpack.unpackb(encode(good), strict_map_key=True)
    array = array_fields(topic.type)[0]
    bad = {"not msgpack": b"\xc1\xc1", "empty": b"", "oversized": bytes(MAX_BYTES + 1), "cut": encode(good)[:-3],
           "another type": encode(sample(Status)), "unknown field": msgpack.packb(fields | {"extra": 1}),
           "missing field": msgpack.packb({k: v for k, v in fields.items() if k != array}),
           "no array": msgpack.packb(fields | {array: [1.0]})}
    real = [n for n in array_fields(topic.type) if getattr(good, n).dtype.kind == "f"]
    packed = encode(good)
    value = getattr(good, real[0])
    bad["not a number"] = packed.replace(value.tobytes(), np.full_like(value, np.nan).tobytes(), 1)
    assert bad["not a number"] != packed
    return bad


@pytest.mark.parametrize(("name", "topic"), [(n, t) for n, s in SERVICES.items() for t in s.inputs],
                         ids=lambda v: v if isinstance(v, str) else v.name)
def test_malformed_messages_are_counted_said_and_survived(name, topic):
    part = PARTS[0] if topic.parts else None
    with closing(Running("local", wait_for=("nobody",))) as running:  # the simulator waits: nothing moves but this
        _, before = running.until_status(name, lambda s: s.state == "ready")
        for count, (kind, payload) in enumerate(nonsense(topic).items(), start=1):
            running.listener.publish(topic, part, payload)
            _, status = running.until_status(name, lambda s, n=before.refused + count: s.refused >= n)
            assert status.note.startswith(f"refused: {topic.name}{f'/{part}' if part else ''}: "), kind
            assert status.refused == before.refused + count
            assert status.state == "ready"
        if topic.parts:
            running.listener.publish(topic, "stranger", encode(sample(topic.type, object="stranger")))
            running.until_status(name, lambda s: "'stranger' is not an object" in s.note)
            running.listener.publish(topic, part, encode(sample(topic.type, object="can")))
            running.until_status(name, lambda s: "object: 'can'" in s.note)
        ready = encode(sample(Status, run="", service="nobody", state="ready"))
        for service in SERVICES:
            if service != "simulator":
                running.listener.publish(STATUS, "nobody", ready)
        seen = running.until(lambda t, p, b: t == RESULT and decode(t.type, b).episode == CONFIG.scene.count - 1)
        assert by_key(e for e in seen if e[0] == RESULT)[("result", None)] == locally(encoded=True)["result", None]


def test_a_stray_message_of_another_run_or_step_does_not_stop_the_loop():
    with closing(Running("local", wait_for=("nobody",))) as running:
        running.until_status("planner", lambda s: s.state == "ready")
        for topic, part in ((PERCEPT, "mug"), (GOAL_PERCEPT, "can"), (BELIEF, "mug")):
            message = sample(topic.type, run="other", step=9, seq=2 ** 62, object=part)
            running.listener.publish(topic, part, encode(message))
        _, status = running.until_status("planner", lambda s: s.refused == 1 and "belief/mug: run: 'other'" in s.note)
        assert status.gaps == 0
        running.listener.publish(ACTION, None, encode(sample(ACTION.type, run="r", episode=0, step=4)))
        running.listener.publish(STATUS, "nobody", encode(sample(Status, run="", service="nobody", state="ready")))
        seen = running.until(lambda t, p, b: t == RESULT and decode(t.type, b).episode == CONFIG.scene.count - 1)
        assert by_key(e for e in seen if e[0] == RESULT)[("result", None)] == locally(encoded=True)["result", None]


def test_the_source_begins_when_everyone_is_ready():
    with closing(Running("local", names=("simulator",), wait_for=("perception", "planner"))) as running:
        running.until_status("simulator", lambda s: "perception, planner" in s.note)
        for name, state in (("perception", "ready"), ("planner", "starting"), ("planner", "busy")):
            assert running.health == {}
            running.listener.publish(STATUS, name, encode(sample(Status, run="", service=name, state=state)))
        seen = running.until(lambda t, p, b: t == FRAME)
        states = [decode(Status, b).state for t, p, b in seen if t == STATUS and p == "planner"]
        assert states == ["starting", "busy"]


def test_a_service_says_what_it_waits_for_and_goes_on_when_it_comes(monkeypatch):
    monkeypatch.setattr("saccade.shared.loop.main.IDLE_S", 0.05)
    with closing(Running("local", names=("planner",))) as running:
        running.until_status("planner", lambda s: s.state == "ready")
        running.listener.publish(BELIEF, "can", encode(sample(BELIEF.type, run="r", object="can", step=0)))
        running.until_status("planner", lambda s: s.note == "waits for belief/mug of step 0 of episode 3")
        running.listener.publish(BELIEF, "mug", encode(sample(BELIEF.type, run="r", object="mug", step=0)))
        running.until(lambda t, p, b: t == ACTION)
        running.until_status("planner", lambda s: s.note == "")


def test_lost_messages_show_in_the_status():
    with closing(Running("local", names=("evaluator",))) as running:
        running.until_status("evaluator", lambda s: s.state == "ready")
        for seq in (0, 1, 5):
            running.listener.publish(TRUTH, None, encode(sample(TRUTH.type, run="r", step=seq, seq=seq, done=False)))
        _, status = running.until_status("evaluator", lambda s: s.received == 3)
        assert status.gaps == 3


class Saying:
    """A core that gives what it is told to."""

    def __init__(self, outputs) -> None:
        self.outputs = outputs

    def begin(self, run, episode):
        return ()

    def step(self, inputs):
        return self.outputs


def test_a_core_that_gives_an_invalid_message_ends_with_a_reason_and_publishes_nothing_of_that_step():
    bad = [Output(PLAN, sample(PLAN.type)), Output(PLAN, sample(PLAN.type, g_pose=float("nan")))]
    bus, inbox, seen = LocalBus(), Inbox(), queue.SimpleQueue()
    bus.subscribe([PLAN, STATUS], lambda *item: seen.put(item))
    service = Service("bad", inputs=(TRUTH,), trigger=TRUTH, outputs=(PLAN,))
    ended: queue.SimpleQueue = queue.SimpleQueue()

    def run() -> None:
        try:
            ended.put(serve(service, Saying(bad), bus, PARTS, run="r", inbox=inbox))
        except SaccadeError as error:
            ended.put(error)

    threading.Thread(target=run, daemon=True).start()
    while decode(Status, seen.get(timeout=WAIT_S)[2]).state != "ready":
        pass
    bus.publish(TRUTH, None, encode(sample(TRUTH.type, run="r", step=0)))
    assert "bad gives an invalid plan: g_pose: not a finite number" in str(ended.get(timeout=WAIT_S))
    said = []
    while not seen.empty():
        said.append(seen.get())
    assert {topic for topic, _, _ in said} == {STATUS}


def test_a_run_that_halts_says_who_waits_for_what():
    deaf = [(s, c) for s, c in pairs(CONFIG) if s.name != "perception"]
    with pytest.raises(SaccadeError, match="episode 0 came to a halt: simulator waits for action of step 0"):
        run_local(deaf, PARTS, "r")
    fakes = dict((s.name, (s, c)) for s, c in pairs(CONFIG))
    fakes["perception"] = (fakes["perception"][0], type(fakes["perception"][1])(("mug",)))
    with pytest.raises(SaccadeError, match="belief waits for percept/can of step 0 of episode 0"):
        run_local(list(fakes.values()), PARTS, "r")


@pytest.mark.parametrize(("changes", "expected"), [
    ({"nonsense": 1}, "nonsense"), ({"bus": {"endpoint": "tcp/127.0.0.1:0"}}, "launcher"),
    ({"scene": {"names": None}}, "scene.names")])
def test_a_service_that_cannot_run_says_so_in_one_line(tmp_path, capsys, changes, expected):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"scene": {"names": list(PARTS)}} | changes))
    with pytest.raises(SystemExit) as caught:
        run_module(module("planner"), argv=["--config", str(path)])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("saccade: ")
    assert error.count("\n") == 1
    assert expected in error
