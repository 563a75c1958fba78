"""The rules of the task, one by one, and what `clip` promises at random positions."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.shared.world.geometry import look_at, pose, rotation_angle, rotation_xyz, spherical
from saccade.shared.world.task import (
    LOWER_M,
    MAX_STEPS,
    UPPER_M,
    Episode,
    Spheres,
    apply_action,
    clip,
    errors,
    spheres_around,
    start_pose,
    success,
)

NOTHING = Spheres(np.zeros((0, 3)), np.zeros(0))
FAR_GOAL = look_at([-0.4, 0.0, 0.3], [0.0, 0.0, 0.1])


def random_spheres(rng, count):
    centers = np.c_[rng.uniform(-0.25, 0.25, (count, 2)), rng.uniform(0.05, 0.11, count)]
    return Spheres(centers, rng.uniform(0.13, 0.2, count))


def test_the_start_is_the_papers():
    start = start_pose()
    azimuth, elevation, distance = spherical(start[:3, 3], np.zeros(3))
    assert (azimuth, elevation, distance) == pytest.approx((0.0, np.pi / 4, 0.65))
    np.testing.assert_allclose(start[:3, 3] + 0.65 * -start[:3, 2], 0.0, atol=1e-12)


def test_spheres_are_half_the_diagonal_and_six_centimetres():
    spheres = spheres_around([[0.1, 0.2, 0.05]], [[0.03, 0.04, 0.12]])
    assert spheres.radii_m == pytest.approx([0.065 + 0.06])


@pytest.mark.parametrize(("wanted", "allowed"), [
    ((0.7, 0, 0.3), (0.5, 0, 0.3)), ((0, -0.9, 0.3), (0, -0.5, 0.3)), ((0, 0, 0.0), (0, 0, 0.1)),
    ((0, 0, 0.9), (0, 0, 0.6)), ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3))])
def test_clip_keeps_the_workspace(wanted, allowed):
    np.testing.assert_array_equal(clip(wanted, NOTHING), allowed)


def test_clip_pushes_radially_out_of_a_sphere():
    spheres = Spheres(np.array([[0.0, 0.0, 0.1]]), np.array([0.2]))
    np.testing.assert_allclose(clip([0.05, 0.0, 0.1], spheres), [0.2, 0.0, 0.1])
    np.testing.assert_allclose(clip([0.0, 0.0, 0.1], spheres), [0.0, 0.0, 0.3])  # the very centre: upwards
    np.testing.assert_array_equal(clip([0.0, 0.3, 0.1], spheres), [0.0, 0.3, 0.1])


def test_clip_is_one_pass_in_the_order_of_the_spheres():
    """The second sphere pushes back into the first, and there it stays; the published goals ask for that."""
    first, second = (Spheres(np.array([[x, 0, 0.2]]), np.array([0.18])) for x in (-0.1, 0.1))
    both = Spheres(np.concatenate([first.centers_m, second.centers_m]), np.array([0.18, 0.18]))
    result = clip([0.01, 0.0, 0.2], both)
    np.testing.assert_allclose(result, clip(clip([0.01, 0.0, 0.2], first), second))
    np.testing.assert_allclose(result, [-0.08, 0.0, 0.2])
    assert both.depth_m(result) == pytest.approx(0.16)


def test_clip_ends_with_the_workspace():
    """A place outside is pushed first: only then is it brought in, so the edge of the workspace may lie in a sphere."""
    sphere = Spheres(np.array([[0.45, 0.0, 0.3]]), np.array([0.2]))
    np.testing.assert_allclose(clip([0.55, 0.0, 0.3], sphere), [0.5, 0.0, 0.3])
    np.testing.assert_allclose(clip([0.7, 0.0, 0.3], sphere), [0.5, 0.0, 0.3])


def test_clip_always_ends_in_the_workspace_and_outside_a_lone_sphere_unless_the_workspace_forces_it():
    rng = np.random.default_rng(2)
    for count in (1, 2, 3, 5, 8):
        spheres = random_spheres(rng, count)
        last = Spheres(spheres.centers_m[-1:], spheres.radii_m[-1:])
        for position in rng.uniform(-0.7, 0.7, (400, 3)):
            result = clip(position, spheres)
            assert (result >= LOWER_M).all()
            assert (result <= UPPER_M).all()
            if ((result > LOWER_M) & (result < UPPER_M)).all():
                assert last.depth_m(result) <= 1e-9, "the last sphere had the last word"


def test_clip_takes_many_positions_at_once():
    rng = np.random.default_rng(4)
    spheres, positions = random_spheres(rng, 4), rng.uniform(-0.7, 0.7, (5, 20, 3))
    expected = [[clip(position, spheres) for position in row] for row in positions]
    np.testing.assert_array_equal(clip(positions, spheres), expected)


def test_an_allowed_position_is_left_alone():
    rng = np.random.default_rng(5)
    spheres = random_spheres(rng, 3)
    for position in rng.uniform(LOWER_M, UPPER_M, (300, 3)):
        if spheres.depth_m(position) <= 0:
            np.testing.assert_array_equal(clip(position, spheres), position)


def test_an_action_moves_and_turns_in_world_axes():
    before = pose(rotation_xyz([0.1, 0.2, 0.3]), [0.1, 0.1, 0.3])
    after = apply_action(before, [0.05, -0.02, 0.01], [0.0, 0.0, 0.4])
    np.testing.assert_allclose(after[:3, 3], [0.15, 0.08, 0.31])
    np.testing.assert_allclose(after[:3, :3], rotation_xyz([0, 0, 0.4]) @ before[:3, :3], atol=1e-12)


def test_an_action_is_limited_to_the_action_space():
    after = apply_action(np.eye(4), [3, -3, 0.1], [2, 0, 0])
    np.testing.assert_allclose(after[:3, 3], [0.5, -0.5, 0.1])
    assert rotation_angle(after[:3, :3], np.eye(3)) == pytest.approx(0.5)


def test_rotations_do_not_drift():
    rng, camera = np.random.default_rng(0), start_pose()
    for _ in range(2000):
        camera = apply_action(camera, np.zeros(3), rng.uniform(-0.5, 0.5, 3))
    np.testing.assert_allclose(camera[:3, :3] @ camera[:3, :3].T, np.eye(3), atol=1e-13)


@pytest.mark.parametrize(("offset_m", "turn_rad", "expected"), [
    (0.0, 0.0, True), (0.0749, 0.499, True), (0.0751, 0.0, False), (0.0, 0.501, False), (0.0751, 0.501, False)])
def test_success_needs_both_tolerances(offset_m, turn_rad, expected):
    goal = pose(rotation_xyz([0.3, 0.1, -1.0]), [0.1, 0.1, 0.3])
    camera = pose(rotation_xyz([turn_rad, 0, 0]) @ goal[:3, :3], goal[:3, 3] + (0, 0, offset_m))
    assert success(camera, goal) is expected


def test_errors_are_differences_in_spherical_coordinates_and_wrap():
    center = np.array([0.1, 0.2, 0.05])
    a = center + 0.4 * np.array([np.cos(3.1), np.sin(3.1), 0.0])
    b = center + 0.3 * np.array([np.cos(-3.1), np.sin(-3.1), 0.0])
    azimuth, elevation, distance = errors(a, b, center)
    assert azimuth == pytest.approx(2 * np.pi - 6.2)
    assert elevation == pytest.approx(0.0)
    assert distance == pytest.approx(0.1)
    up = center + 0.3 * np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    assert errors(up, center - np.array([0.0, 0.3, 0.0]), center) == pytest.approx((0.0, np.pi / 4, 0.0), abs=1e-12)


def test_an_episode_ends_at_the_goal():
    goal = start_pose()
    goal[0, 3] -= 0.2
    episode = Episode(goal, NOTHING)
    assert not episode.done
    episode.act([-0.1, 0, 0], np.zeros(3))
    assert not episode.success
    episode.act([-0.1, 0, 0], np.zeros(3))
    assert episode.success
    assert episode.done
    assert episode.step == 2


def test_an_episode_ends_when_its_steps_are_used_up():
    episode = Episode(FAR_GOAL, NOTHING, max_steps=3)
    for _ in range(3):
        assert not episode.done
        episode.act(np.zeros(3), np.zeros(3))
    assert episode.done
    assert not episode.success
    assert MAX_STEPS == 350


def test_success_is_judged_after_actions_only():
    episode = Episode(start_pose(), NOTHING)
    assert not episode.done
    episode.act(np.zeros(3), np.zeros(3))
    assert episode.success


def test_an_episode_without_a_known_goal_never_succeeds():
    episode = Episode(start_pose(), NOTHING, judged=False)
    episode.act(np.zeros(3), np.zeros(3))
    assert not episode.success


def test_the_first_declaration_counts():
    """Wrong once is wrong for good: `declared_true` speaks of the moment when the agent first said so."""
    goal = start_pose()
    goal[0, 3] -= 0.2
    wrong, right = Episode(goal, NOTHING), Episode(goal, NOTHING)
    wrong.act([-0.1, 0, 0], np.zeros(3), arrived=True)
    wrong.act([-0.1, 0, 0], np.zeros(3), arrived=True)
    assert (wrong.success, wrong.declared, wrong.declared_true) == (True, True, False)
    right.act([-0.1, 0, 0], np.zeros(3))
    assert not right.declared
    right.act([-0.1, 0, 0], np.zeros(3), arrived=True)
    assert (right.declared, right.declared_true) == (True, True)


def test_wherever_it_is_commanded_the_camera_is_clipped():
    rng = np.random.default_rng(8)
    spheres = random_spheres(rng, 4)
    episode = Episode(FAR_GOAL, spheres)
    for _ in range(300):
        translation = rng.uniform(-0.5, 0.5, 3)
        expected = clip(episode.camera[:3, 3] + translation, spheres)
        episode.act(translation, rng.uniform(-0.5, 0.5, 3))
        np.testing.assert_array_equal(episode.camera[:3, 3], expected)
