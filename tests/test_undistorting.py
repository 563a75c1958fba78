"""The distortion of a lens is removed: points are where a pinhole camera sees them."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.camera.trajectories.distortion import distorted, undistorted, widest
from saccade.services.camera.trajectories.lens import Lens, lens
from saccade.services.camera.virtual_camera import FILL, VirtualCamera
from saccade.shared.world.geometry import INTRINSICS_PX, project
from saccade.tests.fakes.camera import HERE, centroid, complaint, dots

FIVE = {"k1": -0.28, "k2": 0.09, "p1": 0.002, "p2": -0.0015, "k3": -0.02}
EIGHT = {"k1": 0.11, "k2": -0.05, "p1": 0.004, "p2": 0.003, "k3": 0.03, "k4": 0.2, "k5": 0.04, "k6": 0.01}
FOUR = {"k1": 0.04, "k2": -0.015, "k3": 0.003, "k4": -0.001}
LENSES = [pytest.param(FIVE, False, id="five"), pytest.param(EIGHT, False, id="eight"),
          pytest.param(FOUR, True, id="fisheye")]
POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.08, 0.0], [-0.11, 0.06, 0.1], [0.04, -0.13, 0.05]])


def made(numbers, fisheye, size=(640, 480), focal=430.0) -> Lens:
    return lens({"fx": focal, "fy": 1.01 * focal, "cx": 0.49 * size[0], "cy": 0.52 * size[1], **numbers}, size,
                fisheye=fisheye)


def rays_of(points) -> np.ndarray:
    """The rays (x, y) at depth 1, y down, on which the camera at HERE sees points."""
    local = (points - HERE[:3, 3]) @ HERE[:3, :3]
    return np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:]


@pytest.mark.parametrize(("numbers", "fisheye", "size", "focal"), [
    *(pytest.param(*one.values, (640, 480), 430.0, id=one.id) for one in LENSES),
    pytest.param(FIVE, False, (1280, 960), 1100.0, id="five, large")])
def test_points_are_where_the_training_camera_would_see_them(numbers, fisheye, size, focal):
    """Drawn where the distorting lens shows them, elsewhere than a pinhole would."""
    camera = made(numbers, fisheye, size, focal)
    drawn = camera.pixels(rays_of(POINTS))
    assert np.abs(drawn - project(POINTS, HERE, camera.intrinsics_px)[0]).max() > 1
    seen = VirtualCamera(size, lens=camera).see(dots(drawn, size))
    expected, _ = project(POINTS, HERE, INTRINSICS_PX)
    np.testing.assert_allclose([centroid(np.where(seen == FILL, 0, seen), near) for near in expected], expected,
                               atol=0.25)


@pytest.mark.parametrize(("numbers", "fisheye"), LENSES)
def test_rays_come_back_from_their_pixels(numbers, fisheye):
    rays = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 2))
    back = undistorted(distorted(rays, numbers, fisheye=fisheye), numbers, fisheye=fisheye)
    np.testing.assert_allclose(back, rays, atol=1e-6)


def test_a_pinhole_without_distortion_is_resampled_as_before():
    size, image = (640, 480), np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    plain = VirtualCamera(size, (500.0, 500.0, 320.0, 240.0)).see(image)
    np.testing.assert_array_equal(VirtualCamera(size, lens=Lens((500.0, 500.0, 320.0, 240.0), size)).see(image), plain)


def test_what_lies_beyond_the_model_is_grey_and_not_a_second_image():
    """This polynomial turns back at r = 1 / sqrt(-3 k1): further out it would show the middle again."""
    numbers = {"k1": -1.6}
    turns = widest(numbers, fisheye=False)
    assert turns == pytest.approx((1 / 4.8) ** 0.5, abs=0.01)
    camera = VirtualCamera((640, 480), lens=made(numbers, False))
    seen = camera.see(np.full((480, 640, 3), 9, dtype=np.uint8))
    u, v = np.meshgrid(np.arange(480) + 0.5, np.arange(480) + 0.5)
    radius = np.hypot((u - INTRINSICS_PX[2]) / INTRINSICS_PX[0], (v - INTRINSICS_PX[3]) / INTRINSICS_PX[1])
    assert (seen[radius > turns + 0.01] == FILL).all()
    assert (seen[radius < turns - 0.01] == 9).all()
    assert np.isnan(undistorted(np.array([[5.0, 0.0]]), numbers, fisheye=False)).all()


def test_wrong_coefficients_are_refused_in_one_line():
    assert "would cover 0% of the" in complaint(VirtualCamera, (640, 480), lens=made({"k1": -1e9, "k3": 1e300}, False))
