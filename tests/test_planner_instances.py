"""A planner of whose target there are several: it goes for the best one, and any of them fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from saccade.services.planner.instances import BLOCKED, SURER, WRONG, Tried, best_of, flat, score
from saccade.shared.world.geometry import look_at
from saccade.tests.test_planner_moving import CENTER, NAME, SIDE, belief, plan_of, planner

AWAY = CENTER + np.array([-0.25, -0.25, 0.0])  # nearer to the camera at SIDE's mirror image
THERE = look_at(AWAY + np.array([0.0, -0.4, 0.2]), AWAY)


def both(step, camera, **changes):
    """Two cans, of which the second one has these changes."""
    second = replace(belief(step, camera, center=AWAY), instance=2, **changes)
    return replace(belief(step, camera), further=[second])


def test_the_agent_goes_for_the_one_whose_view_is_near():
    """From THERE the view of the second can is the nearer one; from SIDE that of the first."""
    plan = plan_of(planner(), both(0, THERE))
    assert (plan.target, plan.target_instance) == (NAME, 2)
    assert np.linalg.norm(plan.look_at_m - AWAY) < 0.05
    first = plan_of(planner(), both(0, look_at(CENTER + np.array([0.4, 0.1, 0.2]), CENTER)))
    assert first.target_instance == 1
    assert np.linalg.norm(first.look_at_m - CENTER) < 0.05


def test_one_that_is_hardly_there_is_left():
    assert plan_of(planner(), both(0, THERE, presence=0.01)).target_instance == 1
    assert plan_of(planner(), both(0, THERE, covariance_m2=np.eye(3) * 0.04)).target_instance == 1


def test_one_that_died_is_given_up():
    """The first can is gone and the second one is left, under the same name: the plan is of this one from then on."""
    made = planner()
    assert plan_of(made, both(0, SIDE, presence=0.01)).target_instance == 1
    plan = plan_of(made, replace(belief(1, SIDE, center=AWAY), instance=2))
    assert plan.target_instance == 2
    assert np.linalg.norm(plan.look_at_m - AWAY) < 0.05


def test_the_agent_changes_its_mind_only_for_one_that_is_clearly_better():
    assert best_of({1: 0.0, 2: SURER - 0.1}, 1) == 1
    assert best_of({1: 0.0, 2: SURER + 0.1}, 1) == 2
    assert best_of({2: -5.0, 3: -6.0}, 1) == 2
    assert best_of({1: -np.inf, 2: -np.inf}, 2) == 2


def test_what_was_tried_in_vain_and_what_is_blocked_counts_less():
    eye, said = SIDE[:3, 3], belief(0, SIDE)
    plain = score(said, eye, SIDE, None, is_blocked=False)
    assert score(said, eye, SIDE, Tried(visited=[SIDE]), is_blocked=False) == plain - WRONG
    assert score(said, eye, SIDE, None, is_blocked=True) == plain - BLOCKED
    assert score(said, None, SIDE, None, is_blocked=False) == -np.inf


def test_all_instances_are_known_under_labels_of_their_own():
    """Under the target's name is the one that the agent goes for; so it is an obstacle once, and the others are."""
    told = {NAME: both(0, SIDE)}
    assert {label: each.instance for label, each in flat(told, NAME, 2).items()} == {NAME: 2, f"{NAME}#1": 1}
    assert {label: each.instance for label, each in flat(told, NAME, 1).items()} == {NAME: 1, f"{NAME}#2": 2}
    assert len(planner().obstacles(flat(told, NAME, 2)).centers_m) == 2
