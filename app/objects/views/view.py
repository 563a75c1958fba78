"""Pictures around an object, cut to the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import Array, unit
from saccade.shared.world.photographs import Intrinsics


@dataclass(frozen=True)
class View:
    """A part of a picture that shows the whole object: rgb [H, W, 3] uint8, and the mask [H, W] of the pixels that show
    it. `intrinsics_px` are those of this part; world_from_camera [4, 4] is the camera's pose (OpenGL)."""

    name: str
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    intrinsics_px: Intrinsics
    world_from_camera: Array

    @property
    def position_m(self) -> Array:
        """Where the camera is [3]."""
        return self.world_from_camera[:3, 3]


def directions_of(views: list[View], center_m: Array) -> Array:
    """The directions [V, 3] from a place to the cameras."""
    return unit(np.stack([view.position_m for view in views]) - center_m)
