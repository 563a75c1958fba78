"""The training's camera in the place of the real one: held to projection, not to its own arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from saccade.services.camera.virtual_camera import FILL, VirtualCamera, assumed_intrinsics
from saccade.shared.world.geometry import INTRINSICS_PX, project
from saccade.tests.fakes.camera import HERE, centroid, complaint, dots


@pytest.mark.parametrize(("size", "intrinsics"), [
    ((1280, 720), (910.0, 905.0, 652.3, 351.8)), ((640, 480), (450.0, 452.0, 310.0, 251.0)),
    ((1920, 1080), (1300.0, 1300.0, 960.0, 540.0)), ((640, 480), (*INTRINSICS_PX[:2], 326.285, 231.78))])
def test_points_are_where_the_training_camera_would_see_them(size, intrinsics):
    """Points of the world, drawn where the real camera sees them, are found where one with INTRINSICS_PX would."""
    points = np.array([[0.0, 0.0, 0.0], [0.06, 0.05, 0.0], [-0.07, 0.04, 0.1], [0.02, -0.08, 0.05]])
    drawn, _ = project(points, HERE, intrinsics)
    camera = VirtualCamera(size, intrinsics)
    assert camera.coverage == 1.0
    seen = camera.see(dots(drawn, size))
    expected, _ = project(points, HERE, INTRINSICS_PX)
    np.testing.assert_allclose([centroid(seen, near) for near in expected], expected, atol=0.1)


def test_what_a_narrow_lens_does_not_see_is_grey():
    """Twice the focal length shows the inner quarter, in its right place; the rest is made up, and said so."""
    fx, fy, cx, cy = INTRINSICS_PX
    camera = VirtualCamera((480, 480), (2 * fx, 2 * fy, cx, cy))
    points = np.array([[0.0, 0.0, 0.05], [0.02, 0.03, 0.0]])
    drawn, _ = project(points, HERE, (2 * fx, 2 * fy, cx, cy))
    seen = camera.see(dots(drawn, (480, 480)))
    assert camera.coverage == pytest.approx(0.25, abs=0.003)
    assert camera.coverage == pytest.approx(np.mean(seen[..., 1] != FILL), abs=0.001)
    expected, _ = project(points, HERE, INTRINSICS_PX)
    np.testing.assert_allclose([centroid(np.where(seen == FILL, 0, seen), near) for near in expected], expected,
                               atol=0.1)


def test_unknown_intrinsics_mean_the_central_square():
    """As if it were done by hand: cut the square out of the middle, resize it; 480x480 pixels stay as they are."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (480, 480, 3), dtype=np.uint8)
    np.testing.assert_array_equal(VirtualCamera((480, 480)).see(image), image)
    wide = rng.integers(0, 255, (240, 400, 3), dtype=np.uint8)
    by_hand = Image.fromarray(wide[:, 80:320]).resize((480, 480), Image.Resampling.BILINEAR)
    inner = np.s_[:, 4:-4]  # at the sides the whole image has neighbours that the square has not
    np.testing.assert_array_equal(VirtualCamera((400, 240)).see(wide)[inner], np.asarray(by_hand)[inner])
    np.testing.assert_allclose(assumed_intrinsics((640, 480)), (*INTRINSICS_PX[:2], INTRINSICS_PX[2] + 80,
                                                                INTRINSICS_PX[3]))


@pytest.mark.parametrize(("intrinsics", "words"), [
    ((600.0, 600.0, 640.0, 360.0), "not near the centre of 640x480"), ((0.0, 600.0, 320.0, 240.0), "not positive"),
    ((600.0, float("nan"), 320.0, 240.0), "not finite"),
    ((2000.0, 2000.0, 320.0, 240.0), "cover 13% of the networks'")])
def test_intrinsics_of_other_images_are_refused(intrinsics, words):
    assert words in complaint(VirtualCamera, (640, 480), intrinsics)


def test_an_image_of_another_size_is_refused():
    assert "640x480" in complaint(VirtualCamera((640, 480)).see, np.zeros((640, 480, 3), np.uint8))
