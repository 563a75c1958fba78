"""Which directions around an object count as the same as that of a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import Array, direction, spherical, unit, viewing_grid, wrap
from saccade.shared.world.symmetry import turns_of

HERE_RAD = 0.25  # chosen: directions within this angle count as the same direction; half of the task's tolerance
TURNED_RAD = 0.5  # derived: the task's tolerance for the rotation of the image, which the azimuth changes near the pole


def alike(eye: Array, center: Array, symmetry: int, *, rolled: bool = False) -> NDArray[np.bool_]:
    """Which directions of the viewing grid [E, A] count as that of a camera at `eye` [3] around an object at `center`
    [3]. If the object is symmetric, those from which it looks the same count too. Where cameras may be `rolled`, a
    direction says nothing of how an image is rotated."""
    rows, columns = viewing_grid()
    elevations, azimuths = np.meshgrid(rows, columns, indexing="ij")
    return np.any([_near(eye, center, elevations, azimuths, equal, rolled)
                   for equal in turns_of(symmetry, len(columns))], axis=0)


def _near(eye: Array, center: Array, elevations: Array, azimuths: Array, equal_rad: float,
          rolled: bool) -> NDArray[np.bool_]:
    azimuth, elevation, _ = spherical(eye, center)
    towards = unit(eye - center) if equal_rad == 0.0 else direction(azimuth + equal_rad, elevation)
    near = direction(azimuths, elevations) @ towards > np.cos(HERE_RAD)
    if rolled:
        return np.asarray(near)
    # Near the pole a change of azimuth rotates the image. Only directions with about the present rotation count.
    aside = np.abs(wrap(azimuths - azimuth - equal_rad))
    turned = aside < HERE_RAD / max(float(np.cos(elevation)), HERE_RAD)
    upright = (elevation < np.pi / 2 - 3 * HERE_RAD) | (aside < TURNED_RAD)
    return np.asarray(near & turned & upright)
