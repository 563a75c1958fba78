"""Whether an agent knows how many there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from saccade.app.bench.counting import counted
from saccade.app.bench.table import counted_words
from saccade.app.run.display import Progress
from saccade.app.run.summary import summary
from saccade.shared.bus.messages import Belief, Result, Truth
from saccade.shared.config import Config
from saccade.tests.samples import sample


def belief(name, shares, **changes) -> Belief:
    return replace(sample(Belief, object=name, count_probabilities=np.array(shares)), **changes)


def test_the_likeliest_number_is_compared_with_the_truth():
    """Two cans of which one is believed, and a mug that is believed and there."""
    truth = sample(Truth, target="can", names=["can", "mug", "can"])
    told = counted(truth, {"can": belief("can", [0.0, 0.7, 0.3]), "mug": belief("mug", [0.1, 0.9])})
    assert told == (2, 1, pytest.approx(0.7), 2, 1)
    assert counted(truth, {"can": belief("can", [0.0, 0.3, 0.7])})[:2] == (2, 2)


def test_a_belief_of_an_old_log_counts_by_its_presence():
    assert replace(belief("can", [1.0]), count_probabilities=None, presence=0.8).count() == (1, pytest.approx(0.8))


def test_the_table_says_how_often_the_number_was_right_where_something_is_there_twice():
    right = {"instances": 2, "counted": 2, "kinds": 5, "kinds_counted": 5}
    words = counted_words([right, right | {"counted": 3, "kinds_counted": 4}])
    assert "right at the end: 50.0 % (9.5 to 90.5) of 2 scenes" in words
    assert "of any kind: 90.0 %" in words
    assert counted_words([right | {"instances": 1, "counted": 1}]) == ""


def test_a_run_that_explored_says_how_many_there_are():
    """Of two cans, one place each and their number; of the mug, that is there once, its place only."""
    progress, config = Progress(), Config().with_values({"scene.explore": True})
    cans = belief("can", [0.0, 0.02, 0.98], further=[belief("can", [1.0], instance=2)], presence=0.99)
    progress.beliefs = {"can": replace(cans, further=[replace(cans.further[0], presence=0.99)]),
                        "mug": belief("mug", [0.1, 0.9], presence=0.9)}
    lines = summary(config, [sample(Result)], progress)
    assert [line.split(" at ")[0] for line in lines if line.startswith("found")] == \
        ["found can", "found can#2", "found mug"]
    assert lines[-1] == "there are 2 of can (probability 0.98)"
