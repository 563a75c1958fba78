"""Reads a goal image, and turns it into an image of the camera that the networks know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import IMAGE_SIZE_PX
from saccade.shared.world.photographs import read_photograph
from saccade.shared.world.resampling import Resampling

LONGEST_PX = 4096  # a larger picture is made smaller first
WHOLE = 0.995  # share of the networks' field of view; if the picture covers less, the user is told
BLACK = 0


@dataclass(frozen=True)
class GoalImage:
    """A goal image [480, 480, 3] of uint8 with the intrinsics INTRINSICS_PX. `note` tells the user in one line where
    the intrinsics of the file's picture are from."""

    rgb: NDArray[np.uint8]
    note: str


def read_goal_image(path: Path, intrinsics_px: Sequence[float] | None = None) -> GoalImage:
    """Reads the user's goal image, a PNG or JPEG of any size and mode.

    `intrinsics_px` (fx, fy, cx, cy) are those of the whole upright picture. Without them they are taken from the EXIF
    data. A picture of 480x480 pixels without both is taken as an image of the training's camera, as it is; of any other
    one a horizontal field of view of 60 degrees is assumed. Outside of the picture the goal image is black. Raises
    SaccadeError like `read_photograph`, and if the picture shows nothing of the networks' field of view.
    """
    photo = read_photograph(path, intrinsics_px, longest_px=LONGEST_PX, what="goal image")
    size_px = IMAGE_SIZE_PX, IMAGE_SIZE_PX
    if photo.assumed and photo.size_px == size_px:
        return GoalImage(photo.rgb, f"goal image {path.name}: its intrinsics are not known, and as it has "
                                    f"{size_px[0]}x{size_px[1]} pixels those of the simulator are assumed")
    resampling = Resampling((photo.rgb.shape[1], photo.rgb.shape[0]), photo.intrinsics_px)
    if resampling.coverage == 0:
        raise SaccadeError(f"goal image {path} shows nothing of the networks' field of view with these intrinsics: "
                           "give fx,fy,cx,cy of the whole upright picture")
    wrong = "; if the true one differs, the goal's range is wrong by the same factor" if photo.assumed else ""
    part = "" if resampling.coverage >= WHOLE else (
        f"; it covers {resampling.coverage:.0%} of the networks' field of view, and the rest is black")
    return GoalImage(resampling.of(photo.rgb, BLACK), f"goal image {path.name}: {photo.told}{wrong}{part}")
