"""Valid messages that cannot be of this run, and questions that are none: they are named, and nobody acts on them."""

from __future__ import annotations

import queue
import threading
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from saccade.app.log.check import missing
from saccade.app.run import follow as following
from saccade.app.run.follow import Course, Messages, follow
from saccade.app.run.halt import Pulse
from saccade.app.run.supervisor import Process
from saccade.services.recorder.core import Recorder
from saccade.services.viewer.live import _Feed
from saccade.shared.bus.messages import Status
from saccade.shared.bus.outbox import KEPT_BYTES, Outbox
from saccade.shared.bus.topics import ACTION, FRAME, PERCEPT, PLAN, RESULT, STATUS, TRUTH
from saccade.shared.bus.transport import MOST_QUESTIONS, LocalBus, ZenohBus, _asked, free_endpoint
from saccade.shared.bus.wire import MAX_SMALL_BYTES, MAX_TEXT, MessageError, decode, encode, stamp_of
from saccade.shared.config import Config
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.episodes import Episodes
from saccade.shared.loop.process import MOST_COUNTED, Health, Heartbeat
from saccade.tests.samples import sample

FAR = 2 ** 62
PROCESSES = [Process(name, "") for name in ("router", "simulator", "planner", "evaluator")]
BAD_QUESTIONS = ['{"since":null,"limit":1e999}', '{"since":' + "[" * 10_000 + "}", "[]", "7", "\xff", '{"limit":1}',
                 '{"since":["r",0],"limit":1}', '{"since":["r",0,"x"],"limit":1}', '{"since":{},"limit":true}',
                 '{"since":null,"limit":1}' + " " * 20_000]


class Heard:
    """A watch that only remembers who was heard."""

    stopped = False

    def __init__(self) -> None:
        self.names: list[str] = []

    def heard(self, name, state) -> None:
        self.names.append(name)

    def check(self) -> None:
        """There is nothing to check."""

    def settled(self, since_s) -> bool:
        return True


def status(part: str, state: str, *, run: str = "r", episode: int = 0, service: str | None = None):
    return STATUS, part, encode(sample(Status, run=run, episode=episode, step=0, seq=0, state=state,
                                       service=service or part))


def said(topic, episode: int = 0, *, run: str = "r", seq: int = 0, **changes):
    return topic, None, encode(sample(topic.type, run=run, episode=episode, step=0, seq=seq, **changes))


def stream(*items, bus=None):
    """What a launcher hears, whom it has heard, and what it says of it."""
    arrived, watch, told = queue.SimpleQueue(), Heard(), []
    for item in items:
        arrived.put(item)
    return Messages(arrived, bus or LocalBus(), watch, "r", told.append), watch, told


def test_a_status_of_another_run_or_service_is_named_and_is_no_heartbeat():
    strange = [status("planner", "busy", run="zz"), status("planner", "busy", service="evil")] * 3
    heard, watch, told = stream(*strange, status("planner", "starting", run=""))
    assert [message.state for _, _, message in heard.rest()] == ["starting"]
    assert watch.names == ["planner"]
    assert told == [
        "status/planner came on the bus and is ignored: it is of the run 'zz', not of 'r'",
        "status/planner came on the bus and is ignored: it is of the service 'evil', not of 'planner'"]


def test_a_run_ends_with_its_own_results_and_with_no_others():
    """Someone says that another run has finished, and tells results of episodes that are to come or never will."""
    ready = [status(name, "ready") for name in ("simulator", "planner", "evaluator")]
    heard, _, told = stream(
        *ready, status("simulator", "finished", run="zz"), said(RESULT, FAR, scene="FORGED"),
        said(RESULT, 7, scene="FORGED"), said(RESULT, 1, scene="FORGED"), said(PLAN, FAR), said(TRUTH, 7),
        status("evil", "finished"), said(RESULT, 0), said(PLAN, 1), status("simulator", "ready", episode=1),
        said(RESULT, 1), status("simulator", "finished", episode=1))
    results = follow(heard, Heard(), PROCESSES, None, live=False)
    assert [(result.episode, result.scene) for result in results] == [(0, "mug"), (1, "mug")]
    assert any("a result of episode 7 came while episode 0 went on" in text for text in told), told


def test_a_run_is_over_when_every_episode_up_to_the_last_one_has_its_result():
    course = Course("simulator", judged=True)
    for topic, part, payload in (status("simulator", "finished", episode=1), said(RESULT, 1), said(RESULT, 5)):
        course.take(topic, part, decode(topic.type, payload))
    assert not course.over
    course.take(RESULT, None, decode(RESULT.type, said(RESULT, 0)[2]))
    assert course.over
    assert [result.episode for result in course.in_order] == [0, 1]


def test_whoever_never_answers_does_not_keep_the_launcher_from_listening(monkeypatch):
    monkeypatch.setattr(following, "QUIET_S", 0.0)
    bus, asked, answered = LocalBus(), threading.Event(), threading.Event()

    def hold(*_: object) -> list:
        asked.set()
        assert answered.wait(60)
        return []

    monkeypatch.setattr(bus, "recall", hold)
    heard, watch, _ = stream(status("planner", "ready"), bus=bus)
    assert next(heard) is not None
    assert next(heard) is None
    assert asked.wait(60)  # and is still being asked
    heard._arrived.put(status("evaluator", "ready"))
    assert next(heard) is not None
    assert watch.names == ["planner", "evaluator"]
    answered.set()


def test_silence_means_something_only_when_all_that_came_was_taken():
    heard, _, _ = stream(*[status("planner", "ready")] * 3)
    states = []
    for _ in range(3):
        next(heard)
        states.append(heard.caught_up)
    assert states == [False, False, True]


def test_a_source_waits_for_the_services_of_its_own_run_and_for_results_of_episodes_that_it_has_begun():
    episodes = Episodes(3, "r", ("planner",), closed=True, timed=False)
    assert episodes.heard("planner", decode(Status, status("planner", "ready", run="")[2]))
    assert (episodes.may_begin, episodes.begin(), episodes.may_begin) == (True, 0, False)
    for episode, run in ((FAR, "r"), (7, "r"), (1, "r"), (0, "zz")):
        with pytest.raises(MessageError):
            episodes.close(decode(RESULT.type, said(RESULT, episode, run=run)[2]))
    assert not episodes.may_begin
    episodes.close(decode(RESULT.type, said(RESULT, 0)[2]))
    assert (episodes.may_begin, episodes.begin()) == (True, 1)


def test_a_heartbeat_goes_on_whatever_was_counted_or_said():
    health = Health("planner", gaps=3 * FAR, refused=2 ** 70)
    assert (health.status(0).gaps, health.status(0).refused) == (MOST_COUNTED, MOST_COUNTED)
    encode(health.status(0))
    bus, heard = LocalBus(), []
    bus.subscribe((STATUS,), lambda topic, part, payload: heard.append(decode(Status, payload)))
    health.note, health.state = "\ud800", "ready"
    Heartbeat(bus, health)._publish()
    assert (heard[0].state, heard[0].note) == ("ready", "its status cannot be told: note: a text that is no Unicode")


@pytest.mark.parametrize("question", BAD_QUESTIONS, ids=lambda text: text[:24].strip())
def test_what_is_no_question_is_refused_in_one_way(question):
    with pytest.raises((ValueError, TypeError, KeyError)):
        _asked(question.encode("latin-1"))


def test_a_question_asks_for_no_more_than_there_can_be():
    assert _asked(b"") == (None, 0)
    assert _asked(b'{"since":["r",1,2],"limit":%d}' % 10 ** 30) == (("r", 1, 2), KEPT_BYTES)
    assert _asked(b'{"since":null,"limit":-5}') == (None, 0)


def test_a_service_answers_after_any_question():
    with closing(ZenohBus(free_endpoint("tcp/127.0.0.1:0"), world="test", listen=True)) as bus:
        outbox, message = Outbox(), sample(ACTION.type, run="r", episode=0, step=0, seq=0)
        outbox.keep(ACTION, None, message, encode(message))
        bus.answer([ACTION], outbox.answer)
        for question in BAD_QUESTIONS:
            list(bus._session.get(ACTION.key("test"), payload=question.encode("latin-1"), timeout=5.0))
        assert [kept.at for kept in bus.recall([ACTION], ("r", 0, 0))] == [("r", 0, 0)]
    assert bus._questions.qsize() < MOST_QUESTIONS


def test_a_stamp_may_be_as_long_as_a_message_allows():
    run = "\N{TEAPOT}" * (MAX_TEXT // 4)
    assert stamp_of(encode(sample(ACTION.type, run=run, episode=FAR, step=FAR, seq=FAR))) == (run, FAR, FAR, FAR)


@pytest.fixture
def recorder(tmp_path):
    config = Config().with_values({"run": "r", "bus.wait_for": ["planner", "recorder"]})
    recorder = Recorder(LocalBus(), tmp_path, config)
    yield recorder
    recorder.log.close()


def test_what_cannot_be_there_yet_is_not_recorded(recorder):
    """Only the source's word that several episodes went by while the recorder was away is believed."""
    for item in (said(TRUTH, 0), said(RESULT, FAR), said(RESULT, 1), said(TRUTH, FAR), said(TRUTH, 2), said(TRUTH, 1),
                 said(RESULT, 1), status("planner", "busy", episode=9), said(TRUTH, 9),
                 status("simulator", "ready", episode=5), said(TRUTH, 5)):
        recorder._take(*item)
    assert recorder.health.refused == 5
    assert recorder.health.note == "refused: truth: it is of episode 9, while episode 1 goes on, and is not recorded"
    recorder.log.close()
    found = [(topic, message.episode) for topic, _, message in RunReader(recorder.log.path) if topic != STATUS]
    assert found == [(TRUTH, 0), (TRUTH, 1), (RESULT, 1), (TRUTH, 5)]


def test_an_object_that_the_run_does_not_have_is_not_recorded(tmp_path):
    config = Config().with_values({"run": "r", "scene.names": ["mug"]})
    recorder = Recorder(LocalBus(), tmp_path, config)
    for part in ("evil", "mug"):
        recorder._take(PERCEPT, part, encode(sample(PERCEPT.type, run="r", episode=0, step=0, seq=0, object=part)))
    recorder.log.close()
    assert [entry.part for entry in RunReader(recorder.log.path).entries()] == ["mug"]
    assert recorder.health.refused == 1


def test_a_recorder_that_waits_for_an_answer_in_vain_does_not_ask_at_every_message(recorder, monkeypatch):
    clock, asked = [100.0], []
    monkeypatch.setattr("saccade.services.recorder.core.time", SimpleNamespace(monotonic=lambda: clock[0]))

    def in_vain(topics, *_: object) -> list:
        asked.append(topics)
        clock[0] += 3.0
        return []

    monkeypatch.setattr(recorder._bus, "recall", in_vain)
    recorder._news_s = clock[0]
    clock[0] += 2.0
    recorder._work_off(status("planner", "ready"))
    first = len(asked)
    recorder._work_off(status("planner", "ready"))
    assert (len(asked), first > 0) == (first, True)


def test_only_the_source_says_that_the_run_is_over(recorder):
    for item in (said(TRUTH, 0), said(TRUTH, 1), status("evil", "finished", episode=1),
                 status("simulator", "finished", service="evil", episode=1), status("simulator", "finished")):
        recorder._take(*item)
    recorder.log.flush()
    assert missing(recorder.log.path).unfinished
    recorder._take(*status("simulator", "finished", episode=1))
    recorder.log.flush()
    assert missing(recorder.log.path).unfinished is None


def test_a_check_names_episodes_that_the_run_did_not_have(recorder):
    for item in (said(TRUTH, 0, done=True), said(RESULT, 0), status("simulator", "finished")):
        recorder._take(*item)
    for episode in (7, FAR):
        recorder.log.write(*said(RESULT, episode))
    recorder.log.close()
    report = missing(recorder.log.path)
    assert f"messages of episodes that the run did not have: 7, {FAR}" in list(report.lines())
    assert not report.complete


def test_the_recorder_writes_nothing_that_its_readers_refuse(recorder, monkeypatch):
    """Nonsense that compresses well: each payload is within its type's limit, and all together are within another."""
    monkeypatch.setattr("saccade.services.recorder.core.MOST_INVALID_BYTES", 3 * MAX_SMALL_BYTES)
    notes = []
    monkeypatch.setattr(recorder.health, "say", lambda state=None, note=None: notes.append(note))
    recorder._take(PERCEPT, "mug", b"\x91" * (MAX_SMALL_BYTES + 1))
    for _ in range(6):
        recorder._take(STATUS, "x", b"\x91" * MAX_SMALL_BYTES)
    recorder._take(*said(TRUTH))
    recorder.log.close()
    sizes = [len(entry.payload) for entry in RunReader(recorder.log.path).entries()]
    assert sizes == [*[MAX_SMALL_BYTES] * 3, len(said(TRUTH)[2])]
    assert sum("a log takes 3145728 bytes of messages that are not valid" in note for note in notes) == 1


def test_a_viewer_shows_one_run():
    shown = []

    class Shown:
        def take(self, topic, part, message) -> None:
            shown.append(message.run)

    health = Health("viewer", at=("r", 0, 0))
    feed = _Feed(Shown(), health)  # type: ignore[arg-type]
    for run in ("zz", "r", "zz"):
        feed.take(*said(FRAME, run=run, rgb=np.zeros((4, 5, 3), np.uint8)))
    feed.take(*status("planner", "ready", run=""))
    assert shown == ["r", ""]


def test_a_halt_names_what_is_waited_for_and_not_what_was_refused(monkeypatch):
    monkeypatch.setattr("saccade.app.run.halt.HALTED_S", 0.0)
    pulse = Pulse({"planner", "recorder"})
    for name, note in (("planner", "waits for belief/mug"), ("recorder", "refused: status/x: it is of the run 'zz'")):
        told = sample(Status, run="r", service=name, state="ready", note=note)
        pulse.take(STATUS, name, told)
    assert pulse.halted() == "the run came to a halt: planner waits for belief/mug"
