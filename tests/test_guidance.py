"""Guidance for a hand: every sign against a case that can be seen in the mind."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, pose, project
from saccade.shared.world.guidance import INSET, frame, guide, hull, level_axes, outline

SIZE = (480, 480)
GAZE = np.zeros(3)
CAMERA = look_at((0.4, 0.0, 0.3), GAZE)  # looks along -x and down: its right is +y
CENTRE = np.array(INTRINSICS_PX[2:])


def moved(by, camera=CAMERA) -> np.ndarray:
    return pose(camera[:3, :3], camera[:3, 3] + by)


def turned(camera, axis, degrees) -> np.ndarray:
    return camera @ pose(Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix(), np.zeros(3))


def told(viewpoint, camera=CAMERA, gaze=GAZE, **more):
    return guide(camera, viewpoint, gaze, INTRINSICS_PX, SIZE, **more)


@pytest.mark.parametrize(("by", "words"), [
    ((0, 0.08, 0), "move 8 cm to the right"), ((0, -0.08, 0), "move 8 cm to the left"),
    ((0, 0, 0.08), "move 8 cm up"), ((0, 0, -0.08), "move 8 cm down"),
    ((-0.08, 0, 0), "move 8 cm forward"), ((0.08, 0, 0), "move 8 cm back"),
    ((0, 0.06, 0.05), "move 6 cm to the right and 5 cm up"), ((0, 0.08, 0.01), "move 8 cm to the right"),
])
def test_a_move_is_told_as_a_person_behind_the_camera_sees_it(by, words):
    assert told(moved(by)).words == words


@pytest.mark.parametrize(("axis", "degrees", "words"), [
    (1, 20, "turn 20 degrees to the left"), (1, -20, "turn 20 degrees to the right"),
    (0, 20, "tilt 20 degrees up"), (0, -20, "tilt 20 degrees down"),
    (2, 20, "roll 20 degrees counter-clockwise"), (2, -20, "roll 20 degrees clockwise"),
])
def test_a_turn_is_told_in_the_axes_of_the_camera(axis, degrees, words):
    """By the right hand: about x the view goes up, about y to the left, about z its right side goes up."""
    guidance = told(turned(CAMERA, axis, degrees))
    assert guidance.words == words
    assert np.degrees(guidance.turn_rad) == pytest.approx(20)


def test_what_is_left_is_a_distance_and_an_angle():
    guidance = told(turned(moved((0, 0.08, 0.06)), 1, 30))
    assert guidance.distance_m == pytest.approx(0.10)
    assert guidance.state == "move"


def test_on_the_way_the_camera_looks_at_what_is_to_be_seen():
    """A board or an object that is out of sight tells nothing."""
    away = turned(moved((0, 0.5, 0)), 1, 90)
    assert told(away).turn_rad == pytest.approx(0, abs=1e-6)
    assert "turn 20 degrees to the right" in told(away, turned(CAMERA, 1, 20)).words


def test_the_arrow_points_where_the_move_goes():
    at = project((0, -0.07, -0.35), np.eye(4), INTRINSICS_PX)[0]
    for by, way in (((0, 0.2, 0), (1, 0)), ((0, -0.2, 0), (-1, 0)), ((0, 0, 0.2), (0, -1)), ((0, 0, -0.2), (0, 1))):
        tip = told(moved(by)).arrow_px[3] - at
        assert tip @ way > 0.8 * np.linalg.norm(tip), by
    far, near = (np.ptp(told(moved((x, 0, 0))).arrow_px[:, 0]) for x in (-0.2, 0.2))
    assert far < near  # in perspective: an arrow away from the camera becomes smaller
    assert (told(CAMERA).arrow_px.size, told(moved((0, 0.2, 0)), there=True).arrow_px.size) == (0, 0)


def test_the_arrow_goes_around_what_the_agent_goes_around():
    beyond = moved((-0.3, 0, 0))
    assert "forward" in told(beyond, step_m=(-0.05, 0.01, 0)).words
    assert told(beyond, step_m=(0, 0, 0.05)).words.startswith("move 30 cm up")
    assert "forward" in told(beyond, step_m=np.zeros(3)).words


def test_near_the_viewpoint_a_hand_holds_still_until_the_agent_has_looked():
    near = turned(moved((0.0, 0.02, 0.0)), 1, 4)
    assert (told(near).state, told(near).words) == ("hold", "hold still")
    assert (told(near, there=True).state, told(near, there=True).words) == ("there", "you are there")


def test_at_the_viewpoint_the_ghost_fits_the_image():
    border = np.array([(INSET, INSET), (1 - INSET, INSET), (1 - INSET, 1 - INSET), (INSET, 1 - INSET)]) * 480
    np.testing.assert_allclose(told(CAMERA).frame_px, border, atol=1e-6)
    nearer = frame(CAMERA, moved(-0.1 * CAMERA[:3, 2]), GAZE, INTRINSICS_PX, SIZE)
    assert (np.abs(nearer - CENTRE) < np.abs(border - CENTRE)).all()  # who comes nearer sees less
    right = frame(CAMERA, moved((0, 0.1, 0)), GAZE, INTRINSICS_PX, SIZE)
    assert (right[:, 0] > border[:, 0]).all()
    assert frame(CAMERA, turned(CAMERA, 1, 180), GAZE, INTRINSICS_PX, SIZE).size == 0  # behind the camera


def test_an_outline_holds_the_object_where_it_should_be_seen():
    ring = outline(CAMERA, (0, 0, 0.05), (0.08, 0.08, 0.10), INTRINSICS_PX)
    far_top, near_bottom, middle = project([(-0.04, 0, 0.1), (0.04, 0, 0), (0, 0, 0.05)], CAMERA, INTRINSICS_PX)[0]
    for edge in (far_top, near_bottom):
        assert np.linalg.norm(ring - edge, axis=1).min() < 1e-6
    assert len(hull([*ring, middle])) == len(ring)
    assert outline(CAMERA, (0.5, 0, 0.35), (0.08, 0.08, 0.10), INTRINSICS_PX).size == 0  # around the camera


def test_forward_is_the_top_of_the_image_for_who_looks_straight_down():
    axes = level_axes(look_at((0, 0, 0.5), GAZE))
    np.testing.assert_allclose(axes, np.stack([(0, -1, 0), (0, 0, 1), (1, 0, 0)], axis=-1), atol=1e-9)


def test_who_follows_the_guidance_arrives():
    """A hand that does a part of what it is told, again and again, comes to the viewpoint from anywhere."""
    rng, goal = np.random.default_rng(5), look_at(0.4 * direction(1.0, 0.6), (0.02, 0.01, 0.05))
    for _ in range(5):
        camera = turned(look_at(0.6 * direction(rng.uniform(-3, 3), rng.uniform(0.3, 1.4)), GAZE), 2, 40)
        for _ in range(60):
            now = told(goal, camera, (0.02, 0.01, 0.05))
            part = Rotation.from_rotvec(0.3 * now.turns_rad[[1, 0, 2]]).as_matrix()
            camera = pose(camera[:3, :3] @ part, camera[:3, 3] + 0.3 * level_axes(camera) @ now.move_m)
        assert now.state == "hold"
