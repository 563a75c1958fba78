"""Live: a source goes by time and nobody waits; whoever is slow takes the newest and says what it left out."""

from __future__ import annotations

import os
import queue
import signal
import threading
import tracemalloc
from collections import defaultdict
from contextlib import closing, suppress

import numpy as np
import pytest

from saccade.app.log.check import missing
from saccade.app.run.launch import ROUTER, launch
from saccade.app.run.supervisor import Process
from saccade.shared.bus.messages import Status
from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, PERCEPT, PLAN, STATUS
from saccade.shared.bus.transport import LocalBus
from saccade.shared.bus.wire import MessageError, decode, encode
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.local import run_local
from saccade.shared.loop.main import serve
from saccade.shared.loop.process import Inbox
from saccade.shared.loop.service import Service
from saccade.shared.loop.stepper import Stepper
from saccade.shared.loop.ticker import Ticker
from saccade.tests.fakes.launch import PARTS, configuration, processes_of
from saccade.tests.fakes.services import BELIEVER, PERCEPTION, PLANNER, FakeBelief, FakePerception, FakePlanner
from saccade.tests.fakes.timed import TIMED, FakeCamera
from saccade.tests.samples import sample

WAIT_S = 30  # for what must come; nothing is asserted about how long it takes
AGENTS = ("perception", "belief", "planner")
PROCESSES = (ROUTER, Process("timed", "saccade.tests.fakes.timed"), 
             *(Process(n, f"saccade.tests.fakes.{n}") for n in AGENTS),
             Process("recorder", "saccade.services.recorder"))


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_pace_does_not_drift_and_leaves_out_what_a_stall_has_missed():
    ticker = Ticker(0.25, clock := Clock())
    assert not ticker.take()  # not before it is started
    ticker.start()
    taken = []
    for clock.now_s in (100.2, 100.3, 100.45, 100.5, 101.6, 101.6, 101.7, 101.75):
        taken.append(ticker.take())
    assert taken == [False, True, False, True, True, False, False, True]
    assert ticker.wait_s == pytest.approx(0.25)
    ticker.stop()
    assert ticker.wait_s == float("inf")


def agents() -> list:
    return [(PERCEPTION, FakePerception(PARTS)), (BELIEVER, FakeBelief(PARTS)), (PLANNER, FakePlanner())]


class Running:
    """Services in threads on a local bus, live, and what they say."""

    def __init__(self, *pairs, wait_for=()) -> None:
        self.bus, self.arrived, self.inboxes, self.threads, self.health = LocalBus(), queue.SimpleQueue(), [], [], {}
        self.bus.subscribe(None, lambda *item: self.arrived.put(item))
        for service, core in pairs:
            self.inboxes.append(Inbox())
            self.threads.append(threading.Thread(target=self._serve, args=(service, core, wait_for, self.inboxes[-1])))
            self.threads[-1].start()

    def _serve(self, service, core, wait_for, inbox) -> None:
        self.health[service.name] = serve(service, core, self.bus, PARTS, run="r", live=True,
                                          wait_for=wait_for, inbox=inbox)

    def until(self, wanted) -> list:
        """(topic, part, message) of what is valid as it comes, up to the first that is wanted."""
        seen = []
        while not seen or not wanted(*seen[-1]):
            topic, part, payload = self.arrived.get(timeout=WAIT_S)
            with suppress(MessageError):
                seen.append((topic, part, decode(topic.type, payload)))
        return seen

    def until_state(self, name: str, state: str) -> list:
        return self.until(lambda t, p, m: t == STATUS and p == name and m.state == state)

    def close(self) -> None:
        for inbox in self.inboxes:
            inbox.stop()
        for thread in self.threads:
            thread.join(WAIT_S)
        assert not any(thread.is_alive() for thread in self.threads)


class Slow:
    """A core that is held up in its steps, and keeps their numbers."""

    def __init__(self) -> None:
        self.steps, self.entered, self.go = [], threading.Semaphore(0), threading.Semaphore(0)

    def begin(self, run, episode):
        return ()

    def step(self, inputs):
        self.steps.append(inputs["frame"].step)
        self.entered.release()
        assert self.go.acquire(timeout=WAIT_S)
        return ()


def test_a_slow_service_takes_the_newest_and_counts_what_it_skips():
    """Also where the newest that came is no good: the one before it is taken."""
    core = Slow()
    with closing(Running((Service("slow", inputs=(FRAME, GOAL), trigger=FRAME, outputs=()), core))) as running:
        running.until_state("slow", "ready")
        running.bus.publish(GOAL, None, encode(sample(GOAL.type, run="r", episode=0, step=0)))
        for steps, bad in ((range(1), False), (range(1, 9), False), (range(9, 12), True), (range(12, 13), False)):
            for step in steps:
                running.bus.publish(FRAME, None, encode(sample(FRAME.type, run="r", episode=0, step=step, seq=step)))
            if bad:
                running.bus.publish(FRAME, None, b"nonsense")
            if steps[0]:
                core.go.release()  # of the step before
            assert core.entered.acquire(timeout=WAIT_S)
        core.go.release()
        running.until(lambda t, p, m: t == STATUS and m.step == 12 and m.state == "ready")
    assert core.steps == [0, 8, 11, 12]
    assert (running.health["slow"].skipped, running.health["slow"].refused) == (7 + 2, 1)


def test_a_source_that_goes_by_time_ends_by_itself_and_everyone_sees_its_last_frame():
    """In their order, whoever skips what; actions are answered with nothing, late or not. Its notes and what it could
    not publish are in its status."""
    camera = FakeCamera(40, 0.002)
    with closing(Running((TIMED, camera), *agents(), wait_for=AGENTS)) as running:
        seen = running.until(lambda t, p, m: t == PLAN and m.step == 39)
        if not any(t == STATUS and m.state == "finished" for t, _, m in seen):
            seen += running.until_state("timed", "finished")
    while not running.arrived.empty():
        topic, part, payload = running.arrived.get()
        seen.append((topic, part, decode(topic.type, payload)))
    steps = defaultdict(list)
    for topic, part, message in seen:
        steps[topic.name, part].append(message.step)
    assert steps["frame", None] == list(range(40))
    for key in (("percept", "mug"), ("belief", "can"), ("plan", None)):
        assert steps[key] == sorted(set(steps[key]))
        assert steps[key][-1] == 39
    assert len(steps["percept", "mug"]) + running.health["perception"].skipped == 40
    assert [running.health[name].refused for name in ("timed", *AGENTS)] == [0, 0, 0, 0]
    said = [m for t, p, m in seen if t == STATUS and p == "timed"]
    assert {"\n".join(camera.notes)} == {m.note for m in said if m.state == "finished"}
    assert {(m.step, m.skipped) for m in said if m.state == "finished"} == {(39, 80)}


@pytest.mark.parametrize("period_s", [0.0005, 1e6])
def test_a_source_that_goes_by_time_stops_when_it_is_told(period_s):
    with closing(Running((TIMED, FakeCamera(10 ** 9, period_s)))) as running:
        running.until(lambda t, p, m: t == FRAME)
    assert running.health["timed"].state == "stopped"


def test_a_source_that_is_started_again_begins_another_episode():
    """What it showed before is past, and its frames' numbers are taken."""
    with closing(Running((TIMED, FakeCamera(3, 0.001)), wait_for=("planner",))) as running:
        running.until_state("timed", "ready")
        running.bus.publish(STATUS, "planner", encode(sample(Status, service="planner", state="ready", run="r",
                                                             episode=4, step=17)))
        seen = running.until_state("timed", "finished")
    assert [(m.episode, m.step) for t, _, m in seen if t == FRAME] == [(5, 0), (5, 1), (5, 2)]


def test_a_service_that_starts_late_asks_for_the_goal_and_not_for_the_past():
    bus, outbox, core = LocalBus(), Outbox(), Slow()
    for topic, step in ((GOAL, 0), (FRAME, 0), (FRAME, 1)):
        message = sample(topic.type, run="r", episode=0, step=step)
        outbox.keep(topic, None, message, encode(message))
    bus.answer((FRAME, GOAL), outbox.answer)
    inbox, service = Inbox(), Service("late", inputs=(FRAME, GOAL), trigger=FRAME, outputs=())
    thread = threading.Thread(target=lambda: serve(service, core, bus, PARTS, run="r", live=True, inbox=inbox))
    ready = threading.Event()
    bus.subscribe((STATUS,), lambda t, p, b: ready.set() if decode(Status, b).state == "ready" else None)
    thread.start()
    assert ready.wait(WAIT_S)
    bus.publish(FRAME, None, encode(sample(FRAME.type, run="r", episode=0, step=7)))
    assert core.entered.acquire(timeout=WAIT_S)
    core.go.release()
    inbox.stop()
    thread.join(WAIT_S)
    assert core.steps == [7]


def test_in_one_process_every_frame_has_its_turn():
    def messages() -> list:
        seen = []
        run_local([(TIMED, FakeCamera(5, 60.0)), *agents()], PARTS, "r", None,
                  lambda t, p, m, payload: seen.append((t, p, m.step, payload)), encoded=True)
        return seen

    seen = messages()
    assert [step for t, _, step, _ in seen if t == PLAN] == [0, 1, 2, 3, 4]
    assert seen.index(next(e for e in seen if e[0] == FRAME and e[2] == 1)) > seen.index(
        next(e for e in seen if e[0] == ACTION and e[2] == 0))
    assert messages() == seen


def test_numbers_that_begin_anew_with_a_later_step_are_new_messages():
    """Of a service that was started again and skipped the past; said twice, a number has the same step."""
    sequences = Sequences()

    def take(step, seq):
        return sequences.take(PERCEPT, "mug", sample(PERCEPT.type, run="r", episode=0, step=step, seq=seq))

    assert [take(*at) for at in ((0, 0), (2, 1), (5, 2))] == [0, 0, 0]
    assert [take(*at) for at in ((2, 1), (5, 2))] == [None, None]
    assert [take(*at) for at in ((9, 1), (9, 1), (8, 0), (10, 2))] == [1, None, 0, 0]
    assert sequences.missing == {}


def test_what_holds_for_the_episode_is_kept_however_much_comes_after_it():
    outbox = Outbox(limit_bytes=250)
    goals, frames = [(0, GOAL, 0), (0, FRAME, 0), (1, GOAL, 0)], [(1, FRAME, step) for step in range(3)]
    for episode, topic, step in goals + frames:
        outbox.keep(topic, None, sample(topic.type, run="r", episode=episode, step=step), bytes(100))
    assert [(k.topic, k.at) for k in outbox.answer((GOAL, FRAME), None, 1000)] == [
        (GOAL, ("r", 1, 0)), (FRAME, ("r", 1, 2))]
    assert outbox.answer((GOAL, FRAME), ("r", 0, 0), 1000)[0].at == ("r", 1, 0)


@pytest.mark.parametrize("noisy", [False, True], ids=["an image with areas of one colour", "an image of noise"])
def test_images_are_kept_in_bounded_memory_and_told_as_they_were_published(noisy):
    images = [np.random.default_rng(step).bytes(100_000) if noisy else bytes([step]) * 100_000 for step in range(20)]
    outbox = Outbox(limit_bytes=1_500_000, memory_bytes=1_000_000)
    tracemalloc.start()
    for step in range(20):
        outbox.keep(FRAME, None, sample(FRAME.type, run="r", episode=0, step=step), bytearray(images[step]))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    told = outbox.answer((FRAME,), ("r", 0, 0), 10_000_000)
    assert [kept.payload for kept in told] == images[-(10 if noisy else 15):]
    assert held < (1_100_000 if noisy else 100_000)


def test_an_action_that_comes_late_is_no_news_for_a_source_that_goes_by_time():
    source = Stepper(TIMED, FakeCamera(3, 1.0), PARTS, source=True, live=True)
    source.begin("r", 0)
    assert [len(source.tick()) for _ in range(3)] == [1, 1, 0]
    source.offer(ACTION, None, sample(ACTION.type, run="r", episode=0, step=0))
    assert source.advance() is None
    assert source.episode_done


@pytest.mark.parametrize("name", ["timed", "perception", "belief", "planner", "recorder"])
def test_killed_while_nobody_waits_a_service_goes_on_with_the_newest(tmp_path, name):
    """The log holds all that came after; a camera begins another episode."""
    killed, frames = [], 120

    def on_message(topic, part, message):
        if topic == PLAN and message.step >= 10 and not killed:
            killed.append(message.step)
            os.kill(processes_of(tmp_path / "run")[name], signal.SIGKILL)

    config = configuration(1, frames).with_values({"bus.live": True})
    said = []
    assert launch(config, tmp_path / "run", on_message, PROCESSES, said.append) == []
    assert any(text.startswith(f"{name} is started again: ") for text in said)
    report = missing(tmp_path / "run" / "run.mcap")
    assert report.cut is None
    if name != "timed":  # what it had not yet handed on is gone with it
        assert report.complete, report
    last = 1 if name == "timed" else 0
    steps = defaultdict(list)
    for topic, part, message in RunReader(tmp_path / "run" / "run.mcap"):
        if topic != STATUS and message.episode == last:
            steps[topic.name, part].append(message.step)
    assert steps["frame", None] == list(range(frames))
    assert steps["plan", None][-1] == frames - 1
    for key in (("percept", "mug"), ("belief", "can"), ("plan", None)):
        assert len(set(steps[key])) == len(steps[key]) > 5
