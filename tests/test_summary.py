"""What is said at the end of a run: how it went, and what the agent itself says where there was nothing to reach."""

from __future__ import annotations

from pathlib import Path

import pytest

from saccade.app.run.display import Progress
from saccade.app.run.summary import summary
from saccade.shared.bus.topics import BELIEF, PLAN, RESULT, TRUTH
from saccade.shared.config import Config
from saccade.tests.samples import sample

GOAL_IMAGE, EXPLORE = {"scene.goal_image": Path("goal.png")}, {"scene.explore": True}
FAILED = "kitchen: did not reach the goal in 12 steps; errors: azimuth 0.500 rad, elevation 0.500 rad, range 0.500 m"
NOT_FOUND = "goal image goal.png: the agent did not find the goal's view in 12 steps"


def told(values, *, success, target="mug", presence=0.98, confidence=0.95):
    """The lines of a run of one episode that ended like this; beside the mug a can that is believed not to be there."""
    progress = Progress()
    progress.take(TRUTH, None, sample(TRUTH.type))
    for name, share in (("mug", presence), ("can", 0.1)):
        progress.take(BELIEF, name, sample(BELIEF.type, object=name, presence=share))
    progress.take(PLAN, None, sample(PLAN.type, target=target, goal_confidence=confidence, arrived=success))
    progress.take(RESULT, None, sample(RESULT.type, scene="kitchen", success=success, declared=success, steps=12))
    return summary(Config().with_values(values), progress.results, progress)


def test_an_ordinary_success_leaves_no_doubt():
    """Neither does another object that is not there."""
    assert told({}, success=True) == [FAILED.replace("did not reach", "reached")]
    assert told(GOAL_IMAGE, success=True) == ["goal image goal.png: the agent says after 12 steps that it is there"]


@pytest.mark.parametrize(("values", "result"), [({}, FAILED), (GOAL_IMAGE, NOT_FOUND)])
def test_a_target_that_is_absent_is_said_with_its_presence(values, result):
    assert told(values, success=False, presence=0.04) == [
        result, "mug was not found: believed not to be there (presence 0.04)"]
    assert told(values, success=False, presence=0.5) == [result]


@pytest.mark.parametrize(("values", "result"), [({}, FAILED), (GOAL_IMAGE, NOT_FOUND)])
def test_a_goal_of_nothing_known_is_said_with_its_confidence(values, result):
    assert told(values, success=False, target="", confidence=0.31) == [
        result, "the goal image shows none of the known objects (confidence 0.31): the agent explored instead"]


def test_who_knows_no_objects_is_not_said_to_have_looked_for_them():
    """LEXA and the random walk name no target in any plan, and believe nothing."""
    progress = Progress()
    progress.take(PLAN, None, sample(PLAN.type, target="", goal_confidence=0.0))
    progress.take(RESULT, None, sample(RESULT.type, scene="kitchen", success=False, declared=False, steps=12))
    assert summary(Config(), progress.results, progress) == [FAILED]


def test_who_only_explores_is_not_said_to_have_missed_anything():
    """There is no goal, so no target either: what was found is told instead."""
    lines = told(EXPLORE, success=False, target="", confidence=0.0)
    assert [line.split(" at ")[0] for line in lines] == ["kitchen: explored for 12 steps", "found mug"]
