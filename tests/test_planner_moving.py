"""A planner whose target moves: its viewpoint goes along, and what it tried before is forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from saccade.services.planner.core import build
from saccade.services.planner.moving import OFTEN, ahead, carried
from saccade.shared.bus.messages import Belief, Plan
from saccade.shared.config import Config
from saccade.shared.world.geometry import direction, look_at, viewing_grid
from saccade.tests.samples import goal_percept, sample

NAME, CENTER, STAMP = "soup_can", np.array([0.05, 0.0, 0.05]), {"run": "r", "episode": 0}
SIDE = look_at(CENTER + 0.4 * direction(-1.5, 0.5), CENTER)
VELOCITY = np.array([0.0, 0.01, 0.0])


def belief(step, camera, *, center=CENTER, velocity_m=None, since_step=0, here=0.0) -> Belief:
    """The can at a centre; the goal's view is at azimuth 0."""
    rows, columns = viewing_grid()
    posterior = -0.5 * ((columns / 0.1) ** 2 + ((rows[:, None] - 0.5) / 0.1) ** 2)
    posterior = (posterior - np.log(np.exp(posterior).sum())).astype(np.float32)
    return Belief(**STAMP, step=step, object=NAME, presence=0.99, world_from_camera=camera, mean_m=np.array(center),
                  covariance_m2=np.eye(3) * 1e-4, particles_m=np.tile(center, (16, 1)).astype(np.float32), views=3,
                  goal_log_posterior=posterior, goal_range_m=0.4, goal_here=here, velocity_m=velocity_m,
                  since_step=since_step)


def planner():
    made = build(Config().with_values({"scene.names": [NAME], "planner.candidates": 30}))
    made.begin("r", 0)
    return made


def plan_of(made, said: Belief) -> Plan:
    inputs = {"belief": {NAME: said}, "goal_percept": {NAME: goal_percept(NAME)}}
    plan, _ = (output.message for output in made.step(inputs))
    return plan


def test_the_viewpoint_of_a_target_that_drifts_is_where_it_will_be_and_goes_along():
    """Between two choices of a viewpoint it moves by the velocity."""
    made = planner()
    first = plan_of(made, belief(0, SIDE, velocity_m=VELOCITY))
    resting = plan_of(planner(), belief(0, SIDE))
    np.testing.assert_allclose(first.viewpoint[:3, 3] - resting.viewpoint[:3, 3], VELOCITY, atol=1e-6)
    second = plan_of(made, belief(1, SIDE, center=CENTER + VELOCITY, velocity_m=VELOCITY))
    np.testing.assert_allclose(second.viewpoint[:3, 3] - first.viewpoint[:3, 3], VELOCITY, atol=1e-9)


def test_the_viewpoint_of_a_target_that_drifts_is_chosen_anew_more_often():
    """It is chosen from where the target is believed by then, which is not where its velocity has led it."""
    made, aside = planner(), CENTER + np.array([0.1, 0.0, 0.0])
    plan_of(made, belief(0, SIDE, velocity_m=VELOCITY))
    plans = [plan_of(made, belief(step, SIDE, center=aside, velocity_m=VELOCITY)) for step in range(1, OFTEN + 1)]
    assert abs(plans[0].viewpoint[0, 3] - plans[-1].viewpoint[0, 3]) > 0.05


def test_when_the_target_was_moved_the_plan_is_made_anew_and_what_was_tried_is_forgotten():
    made, moved_to = planner(), CENTER + np.array([-0.2, 0.1, 0.0])
    first = plan_of(made, belief(0, SIDE))
    plan_of(made, belief(1, first.viewpoint, here=0.01))  # it has arrived, and the view is not the goal's
    assert len(made.now.visited) == 1
    unmoved = plan_of(made, belief(2, SIDE, center=moved_to))
    moved = plan_of(made, belief(3, SIDE, center=moved_to, since_step=3))
    assert made.now.visited == []
    wanted = moved_to + 0.4 * direction(0.0, 0.5)
    assert np.linalg.norm(moved.viewpoint[:3, 3] - wanted) < 0.05 < np.linalg.norm(unmoved.viewpoint[:3, 3] - wanted)


def test_what_rests_is_left_as_it_is():
    said, plan = {NAME: belief(0, SIDE)}, sample(Plan)
    assert ahead(said, NAME) is said
    assert ahead({NAME: replace(said[NAME], velocity_m=VELOCITY)}, None)[NAME].mean_m is said[NAME].mean_m
    assert carried(plan, None) is plan
