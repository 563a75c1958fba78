"""Camera geometry: every function against its inverse or against a case that can be checked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.shared.world.geometry import (
    INTRINSICS_PX,
    direction,
    euler_xyz,
    fibonacci_hemisphere,
    look_at,
    pixel_rays,
    project,
    rotation_angle,
    rotation_towards,
    rotation_xyz,
    spherical,
    unit,
    wrap,
)
from saccade.shared.world.windows import Window


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_look_at_puts_the_target_on_the_principal_point(rng):
    """The crop's principal point is off the image's centre; the target lands on it, not on (240, 240)."""
    cameras, targets = rng.uniform((-1, -1, 1), (1, 1, 3), (200, 3)), rng.uniform(-0.3, 0.3, (200, 3))
    poses = look_at(cameras, targets)
    for pose, target, camera in zip(poses, targets, cameras, strict=True):
        pixel, depth = project(target, pose, INTRINSICS_PX)
        assert pixel == pytest.approx(INTRINSICS_PX[2:], abs=1e-6)
        assert depth == pytest.approx(np.linalg.norm(target - camera))


def test_the_principal_point_is_that_of_the_crop():
    """The published agent kept the uncropped cx = 326.285."""
    assert INTRINSICS_PX[2] == pytest.approx(246.285)
    assert INTRINSICS_PX[3] == pytest.approx(231.780)


def test_look_at_has_no_roll_and_is_a_rotation(rng):
    forward = rng.normal(size=(300, 3))
    rotation = rotation_towards(forward)
    np.testing.assert_allclose(-rotation[:, :, 2], unit(forward), atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2, 0], 0.0, atol=1e-12)  # the image's right stays level
    assert (rotation[:, 2, 1] >= -1e-12).all()  # the image's top points up
    squared = np.einsum("nij,nik->njk", rotation, rotation)
    np.testing.assert_allclose(squared, np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_look_at_straight_down_points_the_image_top_to_x():
    rotation = rotation_towards([0.0, 0.0, -1.0])
    np.testing.assert_allclose(rotation, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_right_and_up_in_the_world_are_right_and_up_in_the_image():
    camera = look_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])  # looks along -x: its right is +y
    center, _ = project([0.0, 0.0, 0.0], camera, INTRINSICS_PX)
    right, _ = project([0.0, 0.1, 0.0], camera, INTRINSICS_PX)
    above, _ = project([0.0, 0.0, 0.1], camera, INTRINSICS_PX)
    np.testing.assert_allclose(right - center, [INTRINSICS_PX[0] * 0.1, 0.0], atol=1e-9)
    np.testing.assert_allclose(above - center, [0.0, -INTRINSICS_PX[1] * 0.1], atol=1e-9)


def test_pixel_rays_invert_project(rng):
    camera = look_at([0.3, -0.4, 0.5], [0.05, 0.0, 0.1])
    pixels = rng.uniform(0, 480, (500, 2))
    depths = rng.uniform(0.1, 2.0, 500)
    rays = pixel_rays(pixels, INTRINSICS_PX)
    points = camera[:3, 3] + (rays * (depths / -rays[:, 2])[:, None]) @ camera[:3, :3].T
    back, depth = project(points, camera, INTRINSICS_PX)
    np.testing.assert_allclose(back, pixels, atol=1e-8)
    np.testing.assert_allclose(depth, depths)


def test_points_behind_the_camera_have_no_positive_depth():
    _, depth = project([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0]], look_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]), INTRINSICS_PX)
    assert (depth <= 1e-12).all()


def test_euler_angles_invert_rotation(rng):
    for angles in rng.uniform(-np.pi, np.pi, (500, 3)) * (1, 0.499, 1):
        np.testing.assert_allclose(euler_xyz(rotation_xyz(angles)), angles, atol=1e-8)


@pytest.mark.parametrize("y", [np.pi / 2, -np.pi / 2])
def test_euler_angles_at_gimbal_lock_still_give_the_rotation(y):
    rotation = rotation_xyz([0.3, y, -0.9])
    np.testing.assert_allclose(rotation_xyz(euler_xyz(rotation)), rotation, atol=1e-6)


def test_rotations_are_about_fixed_axes():
    np.testing.assert_allclose(rotation_xyz([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation_xyz([np.pi / 2, 0, 0]) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation_xyz([np.pi / 2, 0, np.pi / 2]) @ [0, 1, 0], [0, 0, 1], atol=1e-12)


def test_spherical_inverts_direction(rng):
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 400), rng.uniform(-1.5, 1.5, 400)
    distance, center = rng.uniform(0.1, 2, 400), rng.normal(size=(400, 3))
    back = spherical(center + distance[:, None] * direction(azimuth, elevation), center)
    np.testing.assert_allclose(back, [azimuth, elevation, distance], atol=1e-8)


def test_wrap_keeps_the_angle_and_bounds_it(rng):
    angles = rng.uniform(-50, 50, 1000)
    wrapped = wrap(angles)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_rotation_angle_is_that_of_the_relative_rotation():
    a = rotation_xyz([0.2, -0.4, 1.0])
    assert rotation_angle(a, a) == pytest.approx(0.0, abs=1e-7)
    assert rotation_angle(a, rotation_xyz([0, 0, 0.7]) @ a) == pytest.approx(0.7)
    assert rotation_angle(np.eye(3), rotation_xyz([np.pi, 0, 0])) == pytest.approx(np.pi)


def test_fibonacci_points_lie_on_the_upper_hemisphere_and_apart():
    points = direction(*fibonacci_hemisphere(500))
    assert (points[:, 2] > 0).all()
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1) + 10 * np.eye(500)
    assert distances.min(axis=0).min() > 0.5 * np.sqrt(2 * np.pi / 500)


def test_a_crops_cells_and_the_images_pixels_find_one_another():
    """Also of an object far from the optical axis; what is behind a crop's camera is nowhere."""
    up = look_at((0.4, 0.1, 0.5), (0.0, 0.0, 0.0))[2, :3]
    window = Window(np.array([[60.0, 400.0], [246.0, 232.0]]), np.array([0.8, 1.3]), np.array([0.25, 0.1]))
    pixels = window.pixels_of(16, INTRINSICS_PX, up)
    cells = (np.arange(16) + 0.5) / 8 - 1
    for k in range(2):
        back = window.crop_of(pixels[k].reshape(-1, 2), INTRINSICS_PX, up)[k].reshape(16, 16, 2)
        assert np.allclose(back, np.stack(np.meshgrid(cells, cells), axis=-1), atol=1e-9)
        assert np.allclose(window.crop_of(window.pixels, INTRINSICS_PX, up)[k, k], 0.0, atol=1e-9)
    assert np.isnan(window.crop_of([[1e5, 232.0]], INTRINSICS_PX, up)[0]).all()
