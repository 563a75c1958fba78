"""How an object in any pose is turned, and how a camera must be turned to see it as in the goal image."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.belief.attitude import GRID, PoseLikeness, _angles, hypotheses, rotation_grid
from saccade.services.belief.pose import GoalView
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
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

CENTER = np.array([0.1, -0.05, 0.04])
LYING = rotation_xyz((np.pi / 2, 0.0, 0.8))
STANDING = yaw_rotation(0.8)
ON_ITS_HEAD = rotation_xyz((np.pi, 0.0, -1.9))


def camera_at(azimuth, elevation, range_m=0.4, roll=0.0):
    camera = look_at(CENTER + range_m * direction(azimuth, elevation), CENTER)
    camera[:3, :3] = camera[:3, :3] @ yaw_rotation(roll)
    return camera


def seen(camera, rotations, weights=(1.0,), std=0.06) -> Percept:
    """The percept of an object at CENTER that has one of the rotations world_from_object, from a camera."""
    objects = np.linalg.inv(camera) @ np.stack([pose(rotation, CENTER) for rotation in rotations])
    nothing = np.zeros(0, dtype=np.float32)
    return Percept(run="r", episode=0, step=0, object="mug", presence=0.99, pixel=project(CENTER, camera,
                                                                                          INTRINSICS_PX)[0],
                   pixel_std=2.0, scale=0.4 / np.linalg.norm(CENTER - camera[:3, 3]), log_scale_std=0.03,
                   latent_mean=nothing, latent_std=nothing, intrinsics_px=np.array(INTRINSICS_PX),
                   world_from_camera=camera, camera_from_object=objects[0], rotations=objects[:, :3, :3],
                   log_probability=np.log(weights), deviation_rad=np.full(len(objects), std))


def goal_view(camera, rotation, symmetry=1) -> GoalView:
    goal = seen(camera, [rotation])
    return GoalView(BeliefConfig(), PoseLikeness(goal, symmetry), goal, symmetry)


def test_the_grid_leaves_no_rotation_far_from_its_own():
    """And none of its rotations is another's: they are spread evenly."""
    grid = rotation_grid(GRID)
    asked = rotation_grid(97)
    apart = np.array([rotation_angle(grid, rotation).min() for rotation in asked])
    assert apart.max() < 0.2
    assert 0.04 < apart.mean() < 0.15
    np.testing.assert_allclose(np.einsum("nij,nkj->nik", grid[::500], grid[::500]), np.tile(np.eye(3), (24, 1, 1)),
                               atol=1e-12)


def test_angles_by_one_product_are_those_of_the_geometry():
    a, b = rotation_grid(7), rotation_grid(5)
    np.testing.assert_allclose(_angles(a, b), rotation_angle(a[:, None], b[None]), atol=1e-6)


@pytest.mark.parametrize("now", [STANDING, LYING, ON_ITS_HEAD])
@pytest.mark.parametrize("roll", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("elevation", [0.3, 1.5])
def test_the_goals_camera_is_found_in_any_pose_and_roll(now, roll, elevation):
    """The object stood in the goal image as it does now. It is seen from two other sides by rolled cameras."""
    wanted = camera_at(2.5, elevation, roll=roll)
    known = goal_view(wanted, now)
    for azimuth in (0.0, 1.5):
        known.seen(seen(camera_at(azimuth, 0.6, roll=1.0), [now]), CENTER)
    posterior = known.log_posterior()
    assert np.exp(posterior).sum() == pytest.approx(1.0)
    rows, columns = viewing_grid()
    likely = np.exp(posterior)[..., None] * direction(columns, rows[:, None])
    assert unit(likely.sum((0, 1))) @ direction(2.5, elevation) > np.cos(0.1)
    assert rotation_angle(known.views.rotations[0], wanted[:3, :3]) < 0.1
    assert np.exp(known.views.log_probability[0]) > 0.8


def test_where_the_object_was_turned_since_the_goal_image_the_goals_camera_is_turned_with_it():
    wanted = camera_at(1.0, 0.7, roll=0.4)
    known = goal_view(wanted, STANDING)
    known.seen(seen(camera_at(0.0, 0.6), [LYING]), CENTER)
    known.log_posterior()
    assert rotation_angle(known.views.rotations[0], LYING @ STANDING.T @ wanted[:3, :3]) < 0.1


def test_what_may_stand_upright_does():
    """A view that cannot decide between an object that stands and one that lies leaves both, and the first is likelier:
    only few things lie as exactly as that."""
    likeness = PoseLikeness(seen(camera_at(0.0, 0.5), [STANDING]), 1)
    view = likeness.of(seen(camera_at(0.0, 0.6), [STANDING, LYING], (0.5, 0.5)), CENTER)
    rotations, prior = hypotheses()
    probability = prior * np.exp(view)
    standing = rotations[:, 2, 2] > 0.95
    lying = rotation_angle(rotations, LYING) < 0.5
    assert probability[standing].sum() > 5 * probability[lying].sum() > 0.0


def test_two_rotations_that_a_view_cannot_tell_apart_are_both_told_and_a_further_view_decides():
    other = LYING @ yaw_rotation(np.pi)
    wanted = camera_at(2.0, 0.8)
    known = goal_view(wanted, LYING)
    known.seen(seen(camera_at(0.0, 0.6), [LYING, other], (0.5, 0.5)), CENTER)
    known.log_posterior()
    first = known.views
    assert len(first.rotations) >= 2
    assert {min(rotation_angle(first.rotations[:2], r @ LYING.T @ wanted[:3, :3])) < 0.1
            for r in (LYING, other)} == {True}
    known.seen(seen(camera_at(1.5, 0.6), [LYING]), CENTER)
    known.log_posterior()
    assert np.exp(known.views.log_probability[0]) > 0.6
    assert rotation_angle(known.views.rotations[0], wanted[:3, :3]) < 0.1


def test_a_symmetric_object_that_lies_looks_the_same_turned_about_its_own_axis():
    wanted = camera_at(2.0, 0.8)
    known = goal_view(wanted, LYING, symmetry=2)
    known.seen(seen(camera_at(0.0, 0.6), [LYING]), CENTER)
    known.log_posterior()
    same = LYING @ yaw_rotation(np.pi) @ LYING.T @ wanted[:3, :3]
    assert {min(rotation_angle(known.views.rotations[:2], r)) < 0.1 for r in (wanted[:3, :3], same)} == {True}
