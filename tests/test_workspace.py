"""A camera in a workspace runs through nothing, and ways through it are free."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import look_at, rotation_xyz
from saccade.shared.world.sight import seen_shares
from saccade.shared.world.ways import find_way
from saccade.shared.world.workspace import CLEARANCE_M, NO_BOXES, Boxes, BoxReach, ShellReach, Space, boxes_of

REACH = BoxReach(np.array([-0.5, -0.5, 0.1]), np.array([0.5, 0.5, 0.6]))
WALL = Boxes(np.array([[0.0, 0.1, 0.3]]), np.eye(3)[None], np.array([[0.04, 1.2, 0.6]]))  # open on one side: y < -0.5
SHORT_WALL = Boxes(np.array([[0.0, 0.2, 0.3]]), np.eye(3)[None], np.array([[0.04, 1.0, 0.9]]))
LEFT, RIGHT = np.array([-0.3, 0.0, 0.3]), np.array([0.3, 0.0, 0.3])


def heap(rng, count=12):
    turned = np.array([rotation_xyz(rng.uniform(-3, 3, 3)) for _ in range(count)])
    return Boxes(np.c_[rng.uniform(-0.25, 0.25, (count, 2)), rng.uniform(0, 0.2, count)], turned,
                 rng.uniform(0.05, 0.2, (count, 3)))


def test_distances_are_those_of_sampled_surfaces():
    """Of a turned box: outside the distance to the nearest of many surface points, inside negative."""
    rng = np.random.default_rng(1)
    box = heap(rng, 1)
    faces = rng.uniform(-0.5, 0.5, (60_000, 3))
    faces[np.arange(len(faces)), rng.integers(0, 3, len(faces))] = rng.choice([-0.5, 0.5], len(faces))
    surface = box.centers_m[0] + (faces * box.sizes_m[0]) @ box.rotations[0].T
    for point in box.centers_m[0] + rng.uniform(-0.2, 0.2, (40, 3)):
        nearest = np.linalg.norm(surface - point, axis=1).min()
        distance = box.distances_m(point)[0]
        assert abs(abs(distance) - nearest) < 0.004
        assert (distance < 0) == bool((np.abs(box.local(point)[0]) < box.sizes_m[0] / 2).all())
        away = point + 0.001 * box.outwards(point, 0)
        assert box.distances_m(away)[0] == pytest.approx(distance + 0.001, abs=2e-4)


def test_no_move_runs_through_anything():
    """Long moves in heaps end at allowed places, and the straight lines between the stops of short ones are free."""
    rng = np.random.default_rng(2)
    for _ in range(5):
        space = Space(REACH, heap(rng))
        here = space.nearest([0.0, 0.0, 0.1])
        for _ in range(15):
            there = space.moved(here, here + rng.normal(0, 0.25, 3))
            assert space.allows(there)
            here = there
    assert Space(REACH, WALL).moved(LEFT, RIGHT)[0] < -0.02 - CLEARANCE_M + 1e-6


def test_a_free_move_is_carried_out_exactly():
    space = Space(REACH, WALL)
    there = np.array([-0.3, 0.3, 0.4])
    np.testing.assert_array_equal(space.moved(LEFT, there), there)


def test_it_slides_along_what_is_in_the_way():
    there = Space(REACH, WALL).moved(LEFT, np.array([0.3, 0.3, 0.3]))
    assert there[0] == pytest.approx(-0.02 - CLEARANCE_M, abs=1e-5)
    assert there[1] > 0.2


def test_a_camera_gives_way_to_what_stands_at_its_place_now():
    box = Boxes(LEFT[None], np.eye(3)[None], np.full((1, 3), 0.1))
    there = Space(REACH, box).moved(LEFT, np.array([-0.3, 0.01, 0.3]))
    assert Space(REACH, box).allows(there)


def test_a_shell_and_a_limit_from_outside():
    shell = ShellReach(np.zeros(3), 0.3, 0.6)
    space = Space(shell, NO_BOXES)
    np.testing.assert_allclose(np.linalg.norm(space.nearest([0.1, 0.0, 0.0])), 0.3, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(space.nearest([0.0, 5.0, 0.0])), 0.6, atol=1e-6)
    upper = Space(shell, NO_BOXES, also=lambda points: points[:, 2] > 0.2)
    assert upper.nearest([0.1, 0.0, 0.0])[2] > 0.2
    assert upper.moved([0.0, 0.0, 0.4], [0.0, 0.39, 0.05])[2] > 0.2


def test_no_room_at_all_is_said():
    full = Boxes(np.zeros((1, 3)), np.eye(3)[None], np.full((1, 3), 9.0))
    with pytest.raises(SaccadeError, match="finds no room"):
        Space(REACH, full).nearest([0.0, 0.0, 0.3])


def test_a_way_leads_around_a_wall():
    space = Space(REACH, SHORT_WALL)
    assert not space.free(LEFT, RIGHT)
    way, goal = find_way(space, LEFT, [RIGHT])
    assert goal == 0
    assert all(space.free(a, b) for a, b in pairwise(way))
    np.testing.assert_array_equal(way[[0, -1]], [LEFT, RIGHT])
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() < 1.4
    assert find_way(Space(REACH, boxes_of(WALL, Boxes(np.array([[0.0, 0.0, 0.3]]), np.eye(3)[None],
                                                      np.array([[0.04, 3.0, 3.0]])))), LEFT, [RIGHT]) is None


def test_the_nearer_of_several_goals_is_taken():
    space = Space(REACH, SHORT_WALL)
    way, goal = find_way(space, LEFT, [RIGHT, np.array([-0.3, 0.2, 0.4])])
    assert (goal, len(way)) == (1, 2)


def test_what_is_seen():
    """All of an object that is alone, none behind another or a wall or behind the camera."""
    def boxes(*centers):
        return Boxes(np.array(centers), np.array([np.eye(3)] * len(centers)), np.full((len(centers), 3), 0.1))

    camera = look_at([0.5, 0.0, 0.1], [0.0, 0.0, 0.1])
    near, far, behind = [0.2, 0.0, 0.1], [0.0, 0.0, 0.1], [0.9, 0.0, 0.1]
    np.testing.assert_array_equal(seen_shares(camera, boxes(far), NO_BOXES), [1.0])
    shares = seen_shares(camera, boxes(near, far, behind), NO_BOXES)
    assert shares[0] == 1.0
    assert shares[1] < 0.3
    assert shares[2] == 0.0
    wall = Boxes(np.array([[0.3, 0.0, 0.1]]), np.eye(3)[None], np.array([[0.01, 1.0, 1.0]]))
    np.testing.assert_array_equal(seen_shares(camera, boxes(near), wall), [0.0])
