"""Beliefs from percepts that tell rotations: how far an object is turned, and from where it would look as the goal."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.belief.pose import GoalView, TurnLikeness
from saccade.services.belief.turn import TURNS, turn_probability, turns
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, pose, project, rotation_xyz, viewing_grid

CENTER = np.array([0.1, -0.05, 0.04])
TURN = 0.7  # of the object, rad
STD = 0.08


def seen(camera, turned=(TURN,), weights=None, range_m=None, std=STD) -> Percept:
    """The percept of an object at CENTER that may be turned by each of `turned`, from a camera."""
    world_from_object = np.stack([pose(rotation_xyz((0.0, 0.0, turn)), CENTER) for turn in turned])
    camera_from_object = np.linalg.inv(camera) @ world_from_object
    weights = np.full(len(turned), 1 / len(turned)) if weights is None else np.array(weights)
    pixel, _ = project(CENTER, camera, INTRINSICS_PX)
    range_m = np.linalg.norm(CENTER - camera[:3, 3]) if range_m is None else range_m
    nothing = np.zeros(0, dtype=np.float32)
    return Percept(run="r", episode=0, step=0, object="mug", presence=0.99, pixel=pixel, pixel_std=2.0,
                   scale=0.4 / range_m, log_scale_std=0.03, latent_mean=nothing, latent_std=nothing,
                   intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=camera,
                   camera_from_object=camera_from_object[0], rotations=camera_from_object[:, :3, :3],
                   log_probability=np.log(weights), deviation_rad=np.full(len(turned), std))


def camera_at(azimuth, elevation=0.6, range_m=0.5):
    return look_at(CENTER + range_m * direction(azimuth, elevation), CENTER)


def goal_view(azimuth, elevation, **how) -> GoalView:
    goal = seen(camera_at(azimuth, elevation, 0.4), **how)
    return GoalView(BeliefConfig(), TurnLikeness(goal), goal)


@pytest.mark.parametrize("camera", [camera_at(0.3), camera_at(-2.5, 0.1), camera_at(3.1, 1.5)])
def test_one_view_tells_the_turn_from_any_side_also_from_above(camera):
    probability = turn_probability(seen(camera))
    assert probability.sum() == pytest.approx(1.0)
    assert turns()[np.argmax(probability)] == pytest.approx(TURN, abs=2 * np.pi / TURNS)
    assert probability[np.abs(turns() - TURN) < 3 * STD].sum() > 0.9


@pytest.mark.parametrize("goal", [(2.5, 0.6), (-3.1, 1.0), (0.2, 0.1)])
def test_the_goals_direction_is_found_also_where_the_object_stood_otherwise_in_its_image(goal):
    """The goal image was taken of the object turned by 0: it would look like that from `goal` + TURN."""
    known = goal_view(*goal, turned=(0.0,))
    assert known.log_posterior() is None
    for azimuth in (0.0, 1.5):
        known.seen(seen(camera_at(azimuth)), CENTER)
    posterior = known.log_posterior()
    assert np.exp(posterior).sum() == pytest.approx(1.0)
    row, column = np.unravel_index(np.argmax(posterior), posterior.shape)
    rows, columns = viewing_grid()
    assert direction(columns[column], rows[row]) @ direction(goal[0] + TURN, goal[1]) > np.cos(0.14)
    assert known.range_m(posterior) == pytest.approx(0.4, rel=0.02)


def test_a_view_that_cannot_decide_leaves_two_peaks_and_one_that_can_decides():
    known = goal_view(1.0, 0.6, turned=(0.0,))
    known.seen(seen(camera_at(0.0), turned=(TURN, TURN + np.pi)), CENTER)
    around = np.exp(known.log_posterior()).sum(0)
    columns = viewing_grid()[1]

    def share(azimuth):
        return float(around[np.cos(columns - azimuth) > np.cos(0.4)].sum())

    assert share(1.0 + TURN) == pytest.approx(share(1.0 + TURN + np.pi), abs=0.02)
    assert share(1.0 + TURN) > 0.3
    known.seen(seen(camera_at(1.5), turned=(TURN, TURN + np.pi), weights=(0.98, 0.02)), CENTER)
    around = np.exp(known.log_posterior()).sum(0)
    assert share(1.0 + TURN) > 0.85


def test_an_object_that_looks_alike_from_all_sides_has_no_turn():
    probability = turn_probability(seen(camera_at(0.4), turned=np.linspace(-np.pi, np.pi, 24, endpoint=False),
                                        std=0.13))
    assert probability.max() < 1.5 / TURNS


def test_a_pose_that_no_upright_object_has_says_nothing():
    percept = seen(camera_at(0.4))
    flipped = percept.rotations @ rotation_xyz((np.pi, 0.0, 0.0))
    changed = Percept(**{**vars(percept), "rotations": flipped})
    assert np.ptp(turn_probability(changed)) < 0.01


def test_at_the_goals_view_the_agent_knows_that_it_is_there():
    known = goal_view(1.0, 0.6, turned=(0.0,))
    there, elsewhere = seen(camera_at(1.0 + TURN)), seen(camera_at(1.0 + TURN + 1.0))
    for view in (elsewhere, there):
        known.seen(view, CENTER)
    assert known.here(there) > 0.6
    assert known.here(elsewhere) < 0.1
