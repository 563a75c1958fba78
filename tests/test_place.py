"""The place that a goal message tells: what the belief and the planner make of it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from saccade.services.belief.core import build as build_belief
from saccade.services.belief.position import PositionFilter
from saccade.services.planner.core import build
from saccade.services.planner.goal import Preference, turned_onto
from saccade.services.planner.goal_views import goal_eye, goal_viewpoint, heading
from saccade.services.planner.place import PaperGround, Room
from saccade.shared.bus.messages import Belief, Goal, Percept
from saccade.shared.bus.topics import BELIEF
from saccade.shared.config import BeliefConfig, Config
from saccade.shared.world.geometry import (
    INTRINSICS_PX,
    direction,
    look_at,
    pose,
    project,
    rotation_angle,
    rotation_xyz,
    unit,
    viewing_grid,
    yaw_rotation,
)
from saccade.shared.world.place import HIGH_M, place_of
from saccade.shared.world.task import Spheres, apply_action
from saccade.shared.world.ways import Ways
from saccade.shared.world.workspace import CLEARANCE_M, NO_BOXES, Boxes

STAMP = {"run": "r", "episode": 0}
NAME, TOP_M = "soup_can", -0.15
CENTER = np.array([0.0, 0.0, TOP_M + 0.05])
START = look_at([0.6, 0.0, TOP_M + 0.3], CENTER)
ROLLED = look_at(CENTER + 0.35 * direction(2.0, 0.7), CENTER)[:3, :3] @ yaw_rotation(2.2)
WALL = {"obstacle_centers_m": np.array([[0.3, 0.0, TOP_M + 0.2]]), "obstacle_sizes_m": np.array([[0.02, 0.8, 0.4]]),
        "obstacle_yaws_rad": np.zeros(1)}


def told(**more) -> Goal:
    """A low table in a large box, or what is told otherwise."""
    place = {"workspace_m": np.array([[-0.7, -0.7, TOP_M + 0.08], [0.7, 0.7, TOP_M + 0.8]]),
             "table_m": np.array([1.2, 0.8, TOP_M])}
    return Goal(**STAMP, step=0, rgb=np.zeros((4, 4, 3), np.uint8), intrinsics_px=np.array(INTRINSICS_PX),
                **(place | more))


def room(objects: Boxes = NO_BOXES, **more) -> Room:
    return Room(place_of(told(**more))).among(objects)


def belief(step=0, camera=START, towards=(0.0, 0.6), found=True, **more) -> Belief:
    """The can is found, and looks like the goal from an azimuth and elevation. Or nothing is known of it."""
    elevation, azimuth = viewing_grid()
    apart = np.arccos(np.clip(direction(azimuth, elevation[:, None]) @ direction(*towards), -1, 1)) / 0.1
    rng = np.random.default_rng(0)
    cloud = np.tile(CENTER, (64, 1)) if found else rng.uniform([-0.6, -0.4, TOP_M], [0.6, 0.4, TOP_M + 0.5], (64, 3))
    return Belief(**STAMP, step=step, object=NAME, presence=1.0 if found else 0.5, world_from_camera=camera,
                  mean_m=cloud.mean(0), covariance_m2=1e-5 * np.eye(3) if found else np.cov(cloud.T),
                  particles_m=cloud.astype(np.float32), views=3,
                  goal_log_posterior=(-0.5 * apart ** 2).astype(np.float32) if found else None,
                  goal_range_m=0.35 if found else 0.0, goal_here=0.0, **more)


def percept_of(camera, world_from_object, step=0) -> Percept:
    """What a camera sees of the can in this pose."""
    seen, nothing = np.linalg.inv(camera) @ world_from_object, np.zeros(0, np.float32)
    return Percept(**STAMP, step=step, object=NAME, presence=0.99, pixel=project(CENTER, camera, INTRINSICS_PX)[0],
                   pixel_std=2.0, scale=0.4 / np.linalg.norm(CENTER - camera[:3, 3]), log_scale_std=0.03,
                   latent_mean=nothing, latent_std=nothing, intrinsics_px=np.array(INTRINSICS_PX),
                   world_from_camera=camera, camera_from_object=seen, rotations=seen[None, :3, :3],
                   log_probability=np.zeros(1), deviation_rad=np.full(1, 0.05))


def goal_percept() -> Percept:
    return Percept(**STAMP, step=0, object=NAME, presence=1.0, pixel=np.array([246.0, 231.0]), pixel_std=2.0,
                   scale=0.4 / 0.35, log_scale_std=0.05, latent_mean=np.zeros(0, np.float32),
                   latent_std=np.zeros(0, np.float32), intrinsics_px=np.array(INTRINSICS_PX),
                   world_from_camera=np.eye(4))


PREFERENCE = Preference(NAME, 0.35, 0.03, np.array([246.3, 231.8]), np.array(INTRINSICS_PX), 1.0)


def journey(goal: Goal, told_of, steps: int):
    """The plans of an agent and the poses of its camera. It is moved as it says, and nothing stops it."""
    planner = build(Config().with_values({"scene.names": [NAME], "planner.candidates": 300}))
    planner.begin("r", 0)
    camera, poses, plans = START, [START], []
    for step in range(steps):
        inputs = {"belief": {NAME: told_of(step, camera)}, "goal_percept": {NAME: goal_percept()}, "goal": goal}
        plan, action = (output.message for output in planner.step(inputs))
        camera = apply_action(camera, action.translation_m, action.rotation_rad)
        plans.append(plan)
        poses.append(camera)
    return plans, poses


# --- the place

def test_without_a_workspace_there_is_no_place():
    assert place_of(None) is None
    assert place_of(told(workspace_m=None)) is None
    assert place_of(told()) is not None
    assert place_of(told(workspace_m=None, shell_m=np.array([0.7, 0.0, 0.1, 0.25, 0.9]))) is not None


def test_objects_are_looked_for_on_the_table_that_is_told():
    extent = place_of(told()).extent_m(np.zeros((3, 2)))
    np.testing.assert_allclose(extent, [[-0.6, 0.6], [-0.4, 0.4], [TOP_M, TOP_M + HIGH_M]])
    paper = np.array([[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.5]])
    assert place_of(told(table_m=None)).extent_m(paper) is paper


def test_walls_and_the_table_hide_what_is_behind_them_and_not_what_stands_on_the_table():
    place = place_of(told(**WALL))
    eyes = np.array([START[:3, 3], [-0.5, 0.0, TOP_M + 0.3], [0.0, 0.0, TOP_M - 0.5]])
    assert place.hides(eyes, CENTER).tolist() == [True, False, True]
    assert place.hides(eyes[1], [0.2, 0.1, TOP_M + 0.001]).tolist() is False


# --- belief

def test_particles_are_on_the_table_and_behind_a_wall_nothing_is_missed():
    config = BeliefConfig(particles=4000)
    cloud = PositionFilter(config, np.random.default_rng(1), place_of(told(**WALL)))
    assert (cloud.particles[:, 2] > TOP_M).all()
    assert cloud.particles[:, 2].min() < TOP_M + 0.01
    seen = cloud.visible(START, np.array(INTRINSICS_PX), [])
    behind = (cloud.particles[:, 0] < 0.25) & (cloud.particles[:, 2] < TOP_M + 0.2)
    assert not seen[behind & (np.abs(cloud.particles[:, 1]) < 0.2)].any()
    assert seen[cloud.particles[:, 0] > 0.32].any()
    open_place = PositionFilter(config, np.random.default_rng(1), place_of(told()))
    assert open_place.visible(START, np.array(INTRINSICS_PX), [])[behind].mean() > 0.3


def test_without_a_place_the_cloud_is_that_of_the_paper():
    cloud = PositionFilter(BeliefConfig(particles=500), np.random.default_rng(1))
    np.testing.assert_array_equal(cloud.particles, np.random.default_rng(1).uniform(
        [-0.5, -0.5, 0.0], [0.5, 0.5, 0.5], (500, 3)))


@pytest.mark.parametrize("place", [True, False])
def test_the_belief_service_takes_the_place_from_the_goal(place):
    """In a place the can lies on a table that is lower than the paper's, and its goal was rolled. Without one, nothing
    is below the paper's table, and nothing is rolled."""
    lies = pose(rotation_xyz((np.pi / 2, 0.0, 0.4)), CENTER)
    filter_ = build_belief(Config().with_values({"scene.names": [NAME]}))
    filter_.begin("r", 0)
    wanted = pose(ROLLED, CENTER + 0.35 * direction(2.0, 0.7))
    inputs = {"goal": told() if place else told(workspace_m=None), "goal_percept": {NAME: percept_of(wanted, lies)}}
    for step in range(3):
        camera = look_at(CENTER + 0.5 * direction(0.3 * step, 0.6), CENTER)
        inputs["percept"] = {NAME: percept_of(camera, lies, step)}
        known: Belief = next(output.message for output in filter_.step(inputs) if output.topic == BELIEF)
    if not place:
        assert known.mean_m[2] > 0.0
        assert known.goal_rotations is None
        return
    np.testing.assert_allclose(known.mean_m, CENTER, atol=0.02)
    assert rotation_angle(known.goal_rotations[0], ROLLED) < 0.1
    assert known.goal_log_posterior is not None


# --- candidates

def test_the_best_viewpoint_is_one_that_can_be_reached():
    """A closed box of walls is around the best one."""
    sides = [([0.0, 0.15, 0.0], [0.3, 0.02, 0.3]), ([0.0, -0.15, 0.0], [0.3, 0.02, 0.3]),
             ([0.15, 0.0, 0.0], [0.02, 0.3, 0.3]), ([-0.15, 0.0, 0.0], [0.02, 0.3, 0.3]),
             ([0.0, 0.0, 0.15], [0.3, 0.3, 0.02]), ([0.0, 0.0, -0.15], [0.3, 0.3, 0.02])]
    middle = np.array([-0.3, 0.3, TOP_M + 0.4])
    closed = room(obstacle_centers_m=np.array([middle + c for c, _ in sides]),
                  obstacle_sizes_m=np.array([s for _, s in sides]), obstacle_yaws_rad=np.zeros(6))
    eyes = np.array([middle, [-0.3, -0.3, TOP_M + 0.4], [0.3, 0.3, TOP_M + 0.4]])
    assert closed.space.allows(eyes).all()
    assert closed.best(np.array([0.0, 1.0, 2.0]), eyes, START) == 1
    assert room().best(np.array([0.0, 1.0, 2.0]), eyes, START) == 0


def test_of_two_viewpoints_that_are_as_good_the_one_on_the_shorter_way_is_taken():
    """The nearer one is behind a wall that has to be gone around."""
    walled = room(**WALL)
    eyes = np.array([[0.15, 0.0, TOP_M + 0.15], [0.6, 0.6, TOP_M + 0.3]])
    assert walled.best(np.array([0.0, 0.0]), eyes, START) == 1
    assert walled.best(np.array([0.0, 1.0]), eyes, START) == 0


def test_positions_out_of_reach_or_behind_walls_cost():
    walled = room(**WALL)
    eyes = np.array([[0.9, 0.0, TOP_M + 0.2], [0.55, 0.0, TOP_M + 0.25], [-0.4, 0.0, TOP_M + 0.3]])
    cost = walled.hidden_cost(eyes, np.tile(CENTER, (3, 1)))
    assert np.isinf(cost[0])
    assert 1.0 < cost[1] < np.inf
    assert cost[2] == 0.0
    paper = PaperGround(Spheres(np.zeros((0, 3)), np.zeros(0)))
    assert not paper.hidden_cost(eyes, np.tile(CENTER, (3, 1))).any()


def test_the_goal_image_was_not_taken_from_behind_a_wall():
    """Of two directions that look the same, the one that is free is the goal's."""
    both = np.logaddexp(belief(towards=(0.0, 0.4)).goal_log_posterior, belief(towards=(np.pi, 0.4)).goal_log_posterior)
    found = belief()
    found = Belief(**(vars(found) | {"goal_log_posterior": both.astype(np.float32)}))
    size = np.array([0.07, 0.07, 0.1])
    posterior = np.exp(room(**WALL).told(found, PREFERENCE, size).goal_log_posterior)
    assert posterior.sum() == pytest.approx(1.0, abs=1e-4)
    azimuth = viewing_grid()[1]
    assert posterior[:, np.abs(azimuth) < 0.5].sum() < 0.05
    assert room().told(found, PREFERENCE, size).goal_log_posterior is not None
    free = np.exp(room().told(found, PREFERENCE, size).goal_log_posterior)
    assert free[:, np.abs(azimuth) < 0.5].sum() == pytest.approx(0.5, abs=0.02)


# --- plans

def test_the_agent_goes_around_a_wall_and_through_nothing():
    goal = told(**WALL)
    plans, poses = journey(goal, lambda step, camera: belief(step, camera, (np.pi, 0.5)), 40)
    space = place_of(goal).space(NO_BOXES)
    for before, after in pairwise(poses):
        assert space.free(before[:3, 3], after[:3, 3])
    there = CENTER + 0.35 * direction(np.pi, 0.5)
    assert min(np.linalg.norm(each[:3, 3] - there) for each in poses) < 0.02
    assert not space.free(START[:3, 3], there)
    assert {plan.mode for plan in plans} == {"goal"}


def test_the_agent_looks_for_the_target_behind_the_wall_where_it_cannot_see():
    goal = told(**WALL)
    plans, _ = journey(goal, lambda step, camera: belief(step, camera, found=False), 1)
    plan = plans[0]
    place = place_of(goal)
    assert plan.mode == "search"
    assert place.space(NO_BOXES).allows(plan.viewpoint[:3, 3])
    assert not place.hides(plan.viewpoint[:3, 3], plan.look_at_m)


def test_a_believed_object_is_gone_around():
    """The can is between the start and the goal's view on its other side."""
    plans, poses = journey(told(), lambda step, camera: belief(step, camera, (np.pi, 0.1)), 40)
    nearest = min(np.linalg.norm(each[:2, 3] - CENTER[:2]) for each in poses if each[2, 3] < CENTER[2] + 0.1)
    assert nearest > CLEARANCE_M
    assert min(np.linalg.norm(each[:3, 3] - plans[0].viewpoint[:3, 3]) for each in poses) < 0.02


def test_all_ways_from_a_place_tell_what_cannot_be_reached():
    """Behind a wall that divides the place nothing can."""
    divided = room(obstacle_centers_m=np.array([[0.0, 0.0, TOP_M + 0.4]]), obstacle_yaws_rad=np.zeros(1),
                   obstacle_sizes_m=np.array([[0.02, 3.0, 3.0]]))
    ways = Ways(divided.space, START[:3, 3])
    lengths = ways.lengths_m([[0.3, 0.2, TOP_M + 0.3], [-0.3, 0.2, TOP_M + 0.3]])
    assert lengths[0] == pytest.approx(np.hypot(0.3, 0.2), abs=0.16)
    assert np.isinf(lengths[1])
    assert ways.to([[-0.3, 0.2, TOP_M + 0.3]]) is None


def test_wrong_beliefs_that_leave_no_room_stop_nothing():
    """An object that is believed to fill the whole place."""
    full = room(Boxes(np.zeros((1, 3)), np.eye(3)[None], np.full((1, 3), 9.0)))
    np.testing.assert_array_equal(full.nearest(np.array([0.1, 0.9, 0.3])), [0.1, 0.7, 0.3])
    move, _ = full.step(START, look_at([0.3, 0.0, 0.2], CENTER), 0.05)
    assert np.linalg.norm(move) == pytest.approx(0.05)


# --- rolled goals

def lying(**more) -> Belief:
    return belief(towards=(2.0, 0.7), goal_rotations=np.array([ROLLED, rotation_xyz((0.3, 0.2, 0.1))]),
                  goal_rotations_log_probability=np.log([0.9, 0.1]), **more)


def test_the_goals_viewpoint_is_rolled_as_the_belief_says():
    eye = goal_eye(lying(), PREFERENCE, 1, START, room())
    viewpoint = goal_viewpoint(lying(), PREFERENCE, eye, goal_pixel=True)
    assert rotation_angle(viewpoint[:3, :3], ROLLED) < 1e-6
    np.testing.assert_allclose(project(CENTER, viewpoint, INTRINSICS_PX)[0], PREFERENCE.pixel, atol=1e-6)
    assert np.linalg.norm(eye - CENTER) == pytest.approx(0.35)
    beside = eye + np.array([0.05, 0.0, 0.02])
    near = goal_viewpoint(lying(), PREFERENCE, beside, goal_pixel=True)
    assert rotation_angle(near[:3, :3], ROLLED) < 0.3
    np.testing.assert_allclose(project(CENTER, near, INTRINSICS_PX)[0], PREFERENCE.pixel, atol=1e-6)


def test_on_the_way_the_camera_looks_at_the_target_and_is_rolled_already():
    viewpoint = goal_viewpoint(lying(), PREFERENCE, goal_eye(lying(), PREFERENCE, 1, START, room()), goal_pixel=True)
    way = heading(START, viewpoint, CENTER, rolled=True)
    assert unit(CENTER - START[:3, 3]) @ way[:3, :3] @ [0.0, 0.0, -1.0] == pytest.approx(1.0)
    assert rotation_angle(way[:3, :3], look_at(START[:3, 3], CENTER)[:3, :3]) > 0.5
    np.testing.assert_array_equal(heading(START, viewpoint, CENTER, rolled=False)[:3, :3],
                                  look_at(START[:3, 3], CENTER)[:3, :3])


@pytest.mark.parametrize("towards", [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 1e-4, 1.0]])
def test_a_camera_is_turned_onto_any_direction(towards):
    turned = turned_onto(ROLLED, PREFERENCE.ray, unit(towards))
    np.testing.assert_allclose(turned @ PREFERENCE.ray, unit(towards), atol=1e-9)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turned) == pytest.approx(1.0)


def test_the_agent_arrives_rolled():
    _, poses = journey(told(), lambda step, camera: lying(step=step, camera=camera), 40)
    there = CENTER + 0.35 * direction(2.0, 0.7)
    arrived = [each for each in poses if np.linalg.norm(each[:3, 3] - there) < 0.02]
    assert min(rotation_angle(each[:3, :3], ROLLED) for each in arrived) < 0.06
