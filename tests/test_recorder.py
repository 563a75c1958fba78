"""The recorder as a real process: killed, told to end, without room; the bus goes on in any case."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from saccade.app.log.check import missing
from saccade.services.recorder.core import Recorder, complete
from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.topics import ACTION, GOAL, PERCEPT, RESULT, STATUS
from saccade.shared.bus.transport import LocalBus, ZenohBus, free_endpoint
from saccade.shared.bus.wire import decode, encode
from saccade.shared.config import Config
from saccade.shared.log.reading import RunReader, is_whole
from saccade.shared.log.recording import RunLog
from saccade.tests.fakes.logs import so_far
from saccade.tests.samples import sample

WAIT_S = 60
MOST_LOST_S = 1.0  # what a killed recorder may lose
PAYLOAD = b"no message at all"


class RecorderProcess:
    """The real recorder on a bus, and a publisher beside it."""

    def __init__(self, folder: Path, limit_bytes: int | None = None) -> None:
        endpoint = free_endpoint("tcp/127.0.0.1:0")
        self.bus = ZenohBus(endpoint, world="test", listen=True)
        self.said, self.folder = [], folder
        self.bus.subscribe([STATUS], lambda _topic, _part, payload: self.said.append(payload))
        folder.mkdir(exist_ok=True)
        Config().with_values({"bus.endpoint": endpoint, "bus.world": "test"}).save(folder / "config.json")
        limit = (lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes,) * 2)) if limit_bytes else None
        self.process = subprocess.Popen([sys.executable, "-m", "saccade.services.recorder", "--config",
                                         folder / "config.json"],
                                        stderr=subprocess.PIPE, text=True, preexec_fn=limit)
        self.until(lambda: b"ready" in b"".join(self.said))

    def until(self, condition) -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, "it did not come"
            if self.process.poll() is not None:
                (self.folder / "said").write_text(self.process.stderr.read())
                self.close()
                raise AssertionError("it has ended")
            time.sleep(0.01)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.bus.close()


def steps_in(folder: Path) -> list[int]:
    """Of the actions that have reached the disk."""
    return [message.step for topic, _, message in so_far(folder / "run.mcap") if topic == ACTION]


def test_a_killed_recorder_loses_at_most_a_second(tmp_path):
    """Each message carries the time at which it was sent: all those older than a second at the kill must be there."""
    sent_s = {}
    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        start = time.monotonic()
        while (now := time.monotonic()) - start < 3.5:
            step = len(sent_s)
            sent_s[step] = now
            message = sample(PERCEPT.type, run="run", object="mug", step=step, scale=now, seq=step)
            recorder.bus.publish(PERCEPT, "mug", encode(message))
            time.sleep(0.005)
        killed_s = time.monotonic()
        recorder.process.send_signal(signal.SIGKILL)
        recorder.process.wait(WAIT_S)
        reader = RunReader(tmp_path / "run" / "run.mcap")
        recorded = {m.step: m.scale for t, _, m in reader if t == PERCEPT}
    assert reader.cut is not None
    assert all(recorded[step] == sent_s[step] for step in recorded)
    owed = [step for step, at_s in sent_s.items() if at_s < killed_s - MOST_LOST_S]
    assert len(owed) > 100
    assert set(owed) <= set(recorded), f"lost {len(set(owed) - set(recorded))} of {len(owed)}"


def test_the_recorder_finishes_its_file_and_tells_gaps(tmp_path):
    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        for seq in (0, 1, 2, 5, 6):
            recorder.bus.publish(ACTION, None, encode(sample(ACTION.type, run="run", step=seq, seq=seq)))
        recorder.until(lambda: b"2 lost: action" in b"".join(recorder.said))
        recorder.process.terminate()
        _, error = recorder.process.communicate(timeout=WAIT_S)
    assert recorder.process.returncode == 0
    assert "lacks 2 messages" in error
    report = missing(tmp_path / "run" / "run.mcap")
    assert report.cut is None
    assert report.lost == {"saccade/test/action": 2}


def test_a_recorder_that_is_started_again_goes_on_with_its_log(tmp_path):
    """What was sent while it was away nobody keeps here; what it had written is all there, once."""
    folder = tmp_path / "run"
    for first in (0, 10):
        with closing(RecorderProcess(folder)) as recorder:
            for seq in range(first, first + 5):
                recorder.bus.publish(ACTION, None, encode(sample(ACTION.type, run="run", step=seq, seq=seq)))
            recorder.until(lambda last=seq: last in steps_in(folder))
    assert steps_in(folder) == [*range(5), *range(10, 15)]
    assert [path.name for path in folder.glob("*.mcap")] == ["run.mcap"]


@pytest.mark.parametrize(("run", "limit_bytes", "reason"), [
    ("other", None, "of the run other: move it away"), ("run", 20_000, "recording stopped")])
def test_a_log_that_cannot_be_gone_on_with_is_left_as_it_is(tmp_path, run, limit_bytes, reason):
    folder = tmp_path / "run"
    folder.mkdir()
    log = RunLog(folder / "run.mcap", world="test", metadata={"run": {"run": run}})
    for seq in range(200):
        log.write(ACTION, None, encode(sample(ACTION.type, run=run, step=seq, seq=seq)) + os.urandom(500))
    log.close()
    before = (folder / "run.mcap").read_bytes()
    with pytest.raises(AssertionError, match="ended"), closing(RecorderProcess(folder, limit_bytes=limit_bytes)):
        pass
    assert (folder / "run.mcap").read_bytes() == before
    assert reason in (folder / "said").read_text()


def test_what_is_no_message_does_not_take_the_number_of_one(tmp_path):
    """Someone's broken message comes first, with a good beginning: both are in the log, and one was refused."""
    good = encode(sample(ACTION.type, run="run", step=0, seq=0))
    value = sample(ACTION.type).translation_m
    broken = good.replace(value.tobytes(), np.full_like(value, np.nan).tobytes(), 1)
    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        recorder.bus.publish(ACTION, None, broken)
        recorder.bus.publish(ACTION, None, good)
        recorder.until(lambda: b"refused: action: translation_m: not finite" in b"".join(recorder.said))
        recorder.process.terminate()
        recorder.process.wait(WAIT_S)
    entries = RunReader(tmp_path / "run" / "run.mcap").entries()
    assert [e.payload for e in entries if e.topic == ACTION] == [broken, good]


def test_what_was_lost_stands_in_the_log_before_what_told_of_it(tmp_path):
    outbox = Outbox()
    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        recorder.bus.answer([ACTION], outbox.answer)
        for seq in range(3):
            message = sample(ACTION.type, run="run", step=seq, seq=seq)
            outbox.keep(ACTION, None, message, encode(message))
            if seq != 1:
                recorder.bus.publish(ACTION, None, encode(message))
        recorder.until(lambda: 2 in steps_in(tmp_path / "run"))
        time.sleep(1.0)  # in which what is asked for again would come again, and reach the disk
    assert steps_in(tmp_path / "run") == [0, 1, 2]


def test_what_holds_for_an_episode_and_was_lost_is_asked_for_when_it_ends(tmp_path):
    outbox = Outbox()
    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        recorder.bus.answer([GOAL, RESULT], outbox.answer)
        for topic in (GOAL, RESULT):
            message = sample(topic.type, run="run", episode=0, step=0, seq=0)
            outbox.keep(topic, None, message, encode(message))
        recorder.bus.publish(RESULT, None, encode(message))
        recorder.until(lambda: RESULT in {t for t, _, _ in so_far(tmp_path / "run" / "run.mcap")})
    assert GOAL in {t for t, _, _ in RunReader(tmp_path / "run" / "run.mcap")}


def test_a_recorder_without_room_says_so_and_the_bus_goes_on(tmp_path):
    with closing(RecorderProcess(tmp_path / "run", limit_bytes=600_000)) as recorder:
        step = 0
        while b"not recording" not in b"".join(recorder.said):
            payload = encode(sample(ACTION.type, run="run", step=step, seq=step)) + os.urandom(3000)
            recorder.bus.publish(ACTION, None, payload)
            step += 1
            time.sleep(0.01)
            assert step < 20_000
        assert recorder.process.poll() is None
        recorder.process.terminate()
        _, error = recorder.process.communicate(timeout=WAIT_S)
    assert recorder.process.returncode == 2
    assert error.startswith("saccade: recording stopped (")
    assert error.count("\n") == 1
    reader = RunReader(tmp_path / "run" / "run.mcap")
    assert sum(e.topic == ACTION for e in reader.entries()) > 10


def test_messages_of_another_run_are_refused_and_named(tmp_path):
    """Also a result, with which an episode of this run would end, and a status; a service that has not begun has no
    run yet."""
    def said_by(run, topic, part=None, **changes):
        changes |= {"service": part} if topic == STATUS else {}
        return topic, part, sample(topic.type, run=run, episode=0, step=0, seq=0, **changes)

    with closing(RecorderProcess(tmp_path / "run")) as recorder:
        for topic, part, message in (said_by("run", ACTION), said_by("", STATUS, "belief"), said_by("run", RESULT)):
            recorder.bus.publish(topic, part, encode(message))
        recorder.until(lambda: RESULT in {t for t, _, _ in so_far(tmp_path / "run" / "run.mcap")})
        for topic, part, message in (said_by("other", RESULT), said_by("other", ACTION), said_by("", ACTION),
                                     said_by("other", STATUS, "planner")):
            place = f"{topic.name}{'/planner' * bool(part)}"
            note = f"refused: {place}: it is of the run '{message.run}', not of 'run'"
            recorder.bus.publish(topic, part, encode(message))
            recorder.until(lambda note=note: note.encode() in b"".join(recorder.said))
        recorder.until(lambda: decode(STATUS.type, recorder.said[-1]).refused == 4)
        recorder.process.terminate()
        assert recorder.process.wait(WAIT_S) == 0
    found = [(t, p, m.run) for t, p, m in RunReader(tmp_path / "run" / "run.mcap") if p != "recorder"]
    assert found == [(ACTION, None, "run"), (STATUS, "belief", ""), (RESULT, None, "run")]


def test_keys_without_end_are_refused_named_once_and_the_run_goes_on(tmp_path, monkeypatch):
    """In this process: the recorder itself on a bus without a network."""
    monkeypatch.setattr("saccade.shared.log.recording.MOST_KEYS", 5)
    recorder = Recorder(LocalBus(), tmp_path, Config().with_values({"run": "r"}))
    notes = []
    monkeypatch.setattr(recorder.health, "say", lambda state=None, note=None: notes.append(note))
    for i in range(70_000):
        message = sample(PERCEPT.type, run="r", episode=0, step=0, seq=0, object=str(i))
        recorder._take(PERCEPT, str(i), PAYLOAD if i > 5 else encode(message))
    recorder._take(PERCEPT, "3", encode(sample(PERCEPT.type, run="r", episode=0, step=1, seq=1, object="3")))
    recorder.log.close()
    assert recorder.health.refused >= 70_000 - 5
    assert [note for note in notes if note and "5 keys at most: more is not recorded" in note] == notes[:1]
    steps = [(entry.part, decode(PERCEPT.type, entry.payload).step) for entry in RunReader(recorder.log.path).entries()]
    assert steps == [*((str(i), 0) for i in range(5)), ("3", 1)]


def test_when_the_source_has_finished_the_log_says_so(tmp_path):
    """Also where the recorder is started once more, after the source has gone."""
    config = Config().with_values({"run": "r", "bus.wait_for": ["planner", "recorder"]})
    recorder = Recorder(LocalBus(), tmp_path, config)
    recorder._take(ACTION, None, encode(sample(ACTION.type, run="r", episode=1, step=0, seq=0)))
    at = {"episode": 1, "service": "simulator"}
    for state, run in (("ready", "r"), ("finished", "other"), ("finished", "")):
        recorder._take(STATUS, "simulator", encode(sample(STATUS.type, run=run, seq=0, state=state, **at)))
    recorder.log.flush()
    assert "the run was not finished: it was ended in episode 1" in missing(tmp_path / "run.mcap").unfinished
    for seq in (1, 2):
        recorder._take(STATUS, "simulator", encode(sample(STATUS.type, run="r", seq=seq, state="finished", **at)))
    recorder.log.flush()
    recorder.log._file.close()  # killed
    assert not is_whole(tmp_path / "run.mcap")
    complete(tmp_path, config)
    assert is_whole(tmp_path / "run.mcap")
    report = missing(tmp_path / "run.mcap")
    assert (report.cut, report.unfinished, report.episodes) == (None, None, [(0, 0)])
    assert "episodes that are not there: 0" in list(report.lines())
    assert not report.complete
