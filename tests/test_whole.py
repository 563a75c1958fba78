"""An episode begins only when all of the one before is in the log, so that no kill loses a part of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from saccade.services.recorder.whole import SILENT_S, Patience, Whole
from saccade.shared.bus.messages import Status
from saccade.shared.bus.topics import ACTION, BELIEF, FRAME, GOAL, RESULT, STATUS, TRUTH
from saccade.shared.loop.episodes import NOT_RECORDING, RECORDER, Episodes
from saccade.tests.samples import sample

STEPS = 3
KEYS = ((FRAME, None, STEPS), (BELIEF, "mug", STEPS), (ACTION, None, STEPS), (TRUTH, None, STEPS + 1))


def said(topic, part, episode, step, **changes):
    return topic, part, dataclasses.replace(sample(topic.type), run="r", episode=episode, step=step, **changes)


def status(service, episode, step, state="ready", run="r"):
    return Status(run=run, episode=episode, step=step, service=service, state=state)


def play(whole, episode, leave_out=()):
    """Takes all messages of an episode but those (topic, step) which are left out."""
    whole.take(*said(GOAL, None, episode, 0))
    for topic, part, count in KEYS:
        for step in range(count):
            if (topic, step) not in leave_out:
                changes = {"done": step == STEPS} if topic == TRUTH else {}
                whole.take(*said(topic, part, episode, step, **changes))
    whole.take(*said(RESULT, None, episode, STEPS))


def test_an_episode_is_whole_when_every_key_came_to_its_end_in_the_first_one_every_service():
    whole = Whole("r", {"belief", "planner"})
    play(whole, 0)
    assert (whole.is_over, whole.is_whole) == (True, False)
    whole.take(STATUS, "belief", status("belief", 0, STEPS - 1))
    whole.take(STATUS, "planner", status("planner", 0, STEPS - 2))
    assert not whole.is_whole
    whole.take(STATUS, "planner", status("planner", 0, STEPS - 1))
    assert whole.is_whole
    assert (whole.next(), whole.is_over) == (1, False)
    play(whole, 1)
    assert (whole.is_over, whole.is_whole) == (True, True)


@pytest.mark.parametrize("lost", [(FRAME, STEPS - 1), (BELIEF, STEPS - 1), (ACTION, STEPS - 1), (TRUTH, STEPS)],
                         ids=lambda lost: lost[0].name)
def test_an_episode_without_its_last_message_is_not_whole(lost):
    whole = Whole("r", set())
    play(whole, 0)
    assert whole.next() == 1
    play(whole, 1, leave_out={lost})
    assert (whole.is_over, whole.is_whole) == (True, False)


def test_a_key_that_was_waited_for_in_vain_is_not_waited_for_again():
    whole = Whole("r", set())
    play(whole, 0, leave_out={(BELIEF, STEPS - 1)})
    assert not whole.is_whole
    whole.give_up()
    assert whole.next() == 1
    play(whole, 1, leave_out={(BELIEF, STEPS - 1)})
    assert whole.is_whole
    assert whole.next() == 2
    play(whole, 2, leave_out={(ACTION, STEPS - 1)})
    assert not whole.is_whole


def test_patience_ends_when_all_have_been_there_for_a_while_and_nothing_came():
    patience = Patience({"belief", "planner"}, 5.0)
    assert not patience.is_over(100.0, 0.0)  # nobody was heard yet
    for now_s in np.arange(101.0, 104.0, 0.5):
        patience.heard("belief", now_s)
        patience.heard("planner", now_s)
        assert not patience.is_over(now_s, 0.0)
    patience.heard("belief", 106.0)
    assert not patience.is_over(106.0, 0.0)  # the planner is silent: it is starting again
    for now_s in np.arange(107.0, 111.0, 0.5):
        patience.heard("belief", now_s)
        patience.heard("planner", now_s)
        assert not patience.is_over(now_s, 0.0)
    assert SILENT_S < 5.0
    patience.heard("belief", 111.5)
    patience.heard("planner", 111.5)
    assert not patience.is_over(111.5, 108.0)  # something came
    assert patience.is_over(113.0, 108.0)


def test_where_nobody_waits_no_episode_is_over():
    whole = Whole("r", None)
    play(whole, 0)
    assert not whole.is_over


def begun():
    """A source whose first episode is over, and closed."""
    episodes = Episodes(2, "r", (RECORDER,), closed=True, timed=False)
    episodes.heard(RECORDER, status(RECORDER, 0, 0, run=""))
    assert episodes.begin() == 0
    episodes.close(said(RESULT, None, 0, 3)[2])
    return episodes


def test_an_episode_begins_when_the_one_before_is_in_the_log_or_there_is_no_log_any_more():
    episodes = begun()
    assert not episodes.may_begin
    assert not episodes.heard(RECORDER, status(RECORDER, 0, 0))
    assert episodes.heard(RECORDER, status(RECORDER, 1, 0))
    assert (episodes.may_begin, episodes.begin()) == (True, 1)
    episodes = begun()
    assert episodes.heard(RECORDER, status(RECORDER, 0, 0, state=NOT_RECORDING))
    assert episodes.may_begin


def test_a_source_that_was_killed_at_the_end_repeats_the_last_episode_and_none_that_the_run_has_not():
    episodes = Episodes(2, "r", (RECORDER,), closed=True, timed=False)
    episodes.heard(RECORDER, status(RECORDER, 2, 0))
    assert (episodes.may_begin, episodes.begin()) == (True, 1)
    assert not episodes.may_begin
    episodes.close(said(RESULT, None, 1, 3)[2])
    assert (episodes.may_begin, episodes.begin()) == (True, None)
