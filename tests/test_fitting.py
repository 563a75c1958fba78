"""Photographs as networks take them, and pixels and masks brought back."""

from __future__ import annotations

import numpy as np

from saccade.app.look.fitting import Fitted, fitted, run_lengths
from saccade.app.look.see_picture import outline
from saccade.shared.world.photographs import Photograph


def test_what_networks_for_squares_get_is_padded_with_black():
    """The photograph stays as it is in the middle, and its rays stay the same."""
    rgb = np.random.default_rng(0).integers(1, 255, (400, 600, 3), dtype=np.uint8)
    photo = Photograph(None, rgb, (1200, 800), (500.0, 510.0, 290.0, 210.0), "", False)
    image = fitted(photo, square=True)
    np.testing.assert_array_equal(image.rgb[100:500], rgb)
    assert image.rgb[:100].max() == image.rgb[500:].max() == 0
    assert image.intrinsics_px == (500.0, 510.0, 290.0, 310.0)
    assert image.back((290.0, 310.0)) == (580.0, 420.0)
    np.testing.assert_array_equal(fitted(photo, square=False).rgb, rgb)


def test_run_lengths_are_cocos():
    """Against a count pixel by pixel, of random grids over photographs of several sizes."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        cells = int(rng.integers(1, 6))
        grid = rng.random((cells, cells)) < rng.choice([0.0, 0.3, 0.7, 1.0])
        size_px = tuple(rng.integers(1, 12, 2))
        side = max(size_px)
        image = Fitted(np.zeros((side, side, 3), np.uint8), (1, 1, 1, 1),
                       tuple((side - count) // 2 for count in size_px), size_px, size_px)
        rows, columns = image.cells(cells, size_px)
        counts = run_lengths(grid, rows, columns)
        pixels = grid[rows][:, columns].T.ravel().tolist()
        expected, value = [0], False
        for pixel in pixels:
            if pixel != value:
                expected.append(0)
                value = pixel
            expected[-1] += 1
        assert counts == expected


def test_an_outline_is_the_border_of_a_mask():
    mask = np.zeros((9, 9), bool)
    mask[2:9, 2:7] = True
    expected = mask.copy()
    expected[3:9, 3:6] = False  # the picture's own border is none
    np.testing.assert_array_equal(outline(mask, 1), expected)
    assert not outline(np.ones((5, 5), bool), 2).any()
