"""A replay of a log that lost a part compares what is whole, and tells what it could not compare; a real difference is
one all the same."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from rich.console import Console

from saccade.app.log.recover import recover
from saccade.app.replay.replay import prepare, replay_here, replay_on_bus
from saccade.app.replay.report import replay_all, tell
from saccade.services.replayer.core import Keys, Pace
from saccade.shared.bus.topics import ACTION, BELIEF, EVENTS, FRAME, GOAL, PERCEPT, PLAN
from saccade.shared.bus.wire import decode, encode, stamp_of
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import LOG, RunLog
from saccade.tests.fixtures.make import GOLDEN

INTO = ("perception", "belief", "planner")
AGENT = (PERCEPT, BELIEF, EVENTS, PLAN, ACTION)


def damaged(path, *, lost=(), cut=None, changed=None):
    """The golden log with a chunk for each message: without the chunks of some (topic, part, step), cut off within that
    of another, recovered. `changed(topic, message)` is what was recorded instead."""
    reader = RunReader(GOLDEN)
    entries = list(reader.entries())
    log = RunLog(path.with_name("whole.mcap"), world=reader.world, configuration=reader.configuration or "{}",
                 metadata={name: told for name, told in reader.metadata.items() if name != LOG})
    places = {}
    for topic, part, payload, time_ns in entries:
        if changed is not None:
            payload = encode(changed(topic, decode(topic.type, payload)))
        log._flushed_s = np.inf
        log.flush()
        start = log.path.stat().st_size
        log.write(topic, part, payload, log_time_ns=time_ns)
        log._flushed_s = np.inf
        log.flush()
        places[topic, part, stamp_of(payload).step] = (start + log.path.stat().st_size) // 2
    log.close()
    data = bytearray(log.path.read_bytes())
    for at in lost:
        data[places[at]] ^= 0xFF
    path.with_name("bad.mcap").write_bytes(data[:places[cut]] if cut else data)
    recover(path.with_name("bad.mcap"), path)
    return path


def replayed(log, tmp_path, run=replay_here, into=INTO):
    """The comparison and what is told of it."""
    replay = prepare(log, into, {}, pace=Pace())
    outcome = run(replay, tmp_path / "replay", Keys(enabled=False), print)
    console = Console(file=io.StringIO(), width=200)
    tell(replay, outcome, console)
    return outcome.comparison, console.file.getvalue()


def count_of(log, *topics, steps):
    return sum(topic in topics and message.step in steps for topic, _, message in RunReader(log))


def test_a_log_whose_end_was_cut_off_is_compared_up_to_there(tmp_path):
    """Of the last step there is the frame and one percept."""
    log = damaged(tmp_path / "log.mcap", cut=(PERCEPT, "soup_can", 3))
    kept = count_of(log, *AGENT, steps=range(4))
    assert kept < count_of(GOLDEN, *AGENT, steps=range(4))
    comparison, told = replayed(log, tmp_path)
    assert (comparison.equal, comparison.beyond) == (True, 0)
    assert comparison.compared == kept + 2  # and the goal percepts
    assert {at[3] for at in comparison.not_compared} == {3}
    assert f"not compared: {len(comparison.not_compared)} messages of episode 0, step 3, of which the log has" in told


def test_what_is_cut_and_not_recovered_is_compared_up_to_there_too(tmp_path):
    damaged(tmp_path / "log.mcap", cut=(PLAN, None, 2))
    comparison, _ = replayed(tmp_path / "bad.mcap", tmp_path)
    assert comparison.equal
    assert {(at[0], at[3]) for at in comparison.not_compared} == {("plan", 2), ("action", 2)}


def test_an_answer_that_was_lost_is_not_compared_and_all_others_are(tmp_path):
    log = damaged(tmp_path / "log.mcap", lost=[(PERCEPT, "soup_can", 1), (PLAN, None, 2)])
    comparison, told = replayed(log, tmp_path)
    assert comparison.equal
    assert sorted(comparison.not_compared) == [("percept", "soup_can", 0, 1), ("plan", None, 0, 2)]
    assert comparison.compared == count_of(GOLDEN, *AGENT, steps=range(4)) + 2 - 2
    assert "not compared: 2 messages of episode 0, step 1-2, of which the log has lost a part\n" in told


@pytest.mark.parametrize("run", [replay_here, replay_on_bus])
def test_behind_an_input_that_was_lost_an_episode_is_not_played(tmp_path, run):
    log = damaged(tmp_path / "log.mcap", lost=[(FRAME, None, 2)])
    comparison, told = replayed(log, tmp_path, run)
    assert comparison.equal
    assert comparison.compared == count_of(GOLDEN, *AGENT, steps=range(2)) + 2
    assert "episode 0, step 2-3, of which" in told


def test_a_service_whose_inputs_are_whole_is_compared_in_every_step(tmp_path):
    log = damaged(tmp_path / "log.mcap", lost=[(FRAME, None, 2)])
    comparison, told = replayed(log, tmp_path, into=("belief", "planner"))
    assert (comparison.equal, comparison.not_compared) == (True, [])
    assert "not compared" not in told


def test_where_nothing_can_be_compared_the_check_fails(tmp_path):
    log = damaged(tmp_path / "log.mcap", lost=[(GOAL, None, 0)])
    comparison, told = replayed(log, tmp_path)
    assert (comparison.compared, comparison.equal) == (0, False)
    assert "nothing could be compared: give a log that is whole" in told


def test_a_real_difference_fails_in_a_damaged_log_as_in_any_other(tmp_path):
    def changed(topic, message):
        return dataclasses.replace(message, arrived=not message.arrived) if (
            topic == PLAN and message.step == 0) else message

    log = damaged(tmp_path / "log.mcap", lost=[(PLAN, None, 2)], changed=changed)
    comparison, _ = replayed(log, tmp_path, into=("planner",))
    assert (comparison.equal, comparison.beyond) == (False, 1)
    assert [(d.topic, d.step, d.field) for d in comparison.differences] == [("plan", 0, "arrived")]


def test_what_a_whole_log_lacks_is_a_difference(tmp_path):
    """It was lost on the bus, or is what a service says today and did not say then."""
    reader, log = RunReader(GOLDEN), None
    for topic, part, payload, time_ns in reader.entries():
        log = log or RunLog(tmp_path / "a.mcap", world=reader.world, configuration=reader.configuration or "{}")
        if (topic, stamp_of(payload).step) != (PLAN, 2):
            log.write(topic, part, payload, log_time_ns=time_ns)
    log.close()
    comparison, told = replayed(log.path, tmp_path, into=("planner",))
    assert not comparison.equal
    assert "only now: plan of step 2 of episode 0" in told


def test_a_log_of_which_nothing_is_left_is_one_clear_error(tmp_path):
    (tmp_path / "bad.mcap").write_bytes(GOLDEN.read_bytes()[:100])
    with pytest.raises(SaccadeError, match="nothing to replay"):
        prepare(tmp_path / "bad.mcap", INTO, {}, pace=Pace())


def test_a_check_says_that_the_log_is_damaged_and_fails(tmp_path, monkeypatch):
    """What is left of it agrees, and a recovered log says by itself what it lacks."""
    log = damaged(tmp_path / "log.mcap", cut=(PLAN, None, 2))
    monkeypatch.setattr("saccade.app.replay.report.Keys", lambda enabled: Keys(enabled=False))
    for path, agrees in ((tmp_path / "bad.mcap", False), (log, True)):
        console = Console(file=io.StringIO(), width=400)
        replays = [prepare(path, ("planner",), {}, pace=Pace())]
        out = tmp_path / path.stem
        assert replay_all(replays, bus="local", out=out, swapped=False, loops=1, console=console) is agrees
        assert ("bad.mcap is cut or damaged" in console.file.getvalue()) is not agrees
        assert ("nothing behind it was compared" in console.file.getvalue()) is not agrees
