"""The bank of an object: what it looks like from all around, flat lit, each view with the direction it is seen from.

A bank is all that the networks which know no names need to know an object: q(p | o) is a distribution over its views,
moving the camera moves along it, and its views are what the agent expects to see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FILLED = 0.92  # of the side of a crop or of a bank's view: the diameter of the circle around its object's outline


@dataclass(frozen=True)
class Bank:
    """V views of an object: images [V, 64, 64, 4] uint8 (RGB, premultiplied by the coverage, and the coverage).

    directions [V, 3] point from the object's centre to the camera, in the object's frame. circles_m [V, 3] are
    the circles around its outline, in metres at its centre: where they are (right, down) from it, and their radii.
    vectors [V, D] are the views' encodings.
    """

    name: str
    images: NDArray[np.uint8]
    directions: NDArray[np.float64]
    circles_m: NDArray[np.float64]
    vectors: NDArray[np.float32]
