"""Turns images of a real camera into images that the camera of the training would have seen.

The networks learned scale = 0.40 m / range at one focal length. Unchanged images of another camera would give wrong
ranges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.undistorting import Undistorting
from saccade.shared.errors import SaccadeError, told
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.images import Size
from saccade.shared.world.photographs import Intrinsics
from saccade.shared.world.resampling import Resampling

MIN_COVERAGE = 0.2  # smallest share of the networks' field of view that images must cover; the rest is filled with grey
CENTRAL = (0.3, 0.7)  # limits of the principal point, as shares of the image's side
FILL = 128  # grey; repeating the image's border instead would enlarge objects there and make others appear


def assumed_intrinsics(size_px: Size) -> Intrinsics:
    """The intrinsics of images of this size (width, height) if their central square is an image of the training.

    The central square, resized to 480x480 pixels, then has the intrinsics of the training.
    """
    side = min(size_px)
    fx, fy, cx, cy = (x * side / IMAGE_SIZE_PX for x in INTRINSICS_PX)
    return fx, fy, cx + (size_px[0] - side) / 2, cy + (size_px[1] - side) / 2


class VirtualCamera:
    """Turns images of `size_px` (width, height) into images of a camera with INTRINSICS_PX at the same pose.

    `intrinsics_px` (fx, fy, cx, cy) are those of the real camera. cx and cy are counted from the corner of the first
    pixel; OpenCV counts from its centre, so its values are half a pixel less. Without intrinsics those of
    `assumed_intrinsics` are used, and the output is the central square. The distortion of a `lens` for images of this
    size is removed; the lens takes the place of the intrinsics. Pixels that the real camera does not see are grey;
    `coverage` is the share of pixels that it sees. Raises SaccadeError if the intrinsics cannot be those of images of
    this size, or if the images cover too little of the networks' field of view.
    """

    def __init__(self, size_px: Size, intrinsics_px: Sequence[float] | None = None, *, lens: Lens | None = None):
        intrinsics_px = lens.of(size_px) if lens else intrinsics_px
        self.size_px = size_px
        need = "give fx, fy, cx, cy of images of this size"
        try:
            fx, fy, cx, cy = map(float, assumed_intrinsics(size_px) if intrinsics_px is None else intrinsics_px)
        except (TypeError, ValueError) as error:
            raise SaccadeError(f"intrinsics {told(intrinsics_px)} are not four numbers: {need}") from error
        name = f"intrinsics ({fx:g}, {fy:g}, {cx:g}, {cy:g}) px"
        if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0):
            raise SaccadeError(f"{name}: not finite, or a focal length that is not positive: {need}")
        width, height = size_px
        if not all(CENTRAL[0] <= share <= CENTRAL[1] for share in (cx / width, cy / height)):
            raise SaccadeError(f"{name}: the principal point is not near the centre of {width}x{height} pixels: {need}")
        self._resampling: Resampling | Undistorting = (
            Undistorting(size_px, lens) if lens and lens.distorts else Resampling(size_px, (fx, fy, cx, cy)))
        self.coverage = self._resampling.coverage
        if self.coverage < MIN_COVERAGE:
            raise SaccadeError(f"{name}: images of {width}x{height} pixels would cover {self.coverage:.0%} of the "
                               f"networks' field of view, less than {MIN_COVERAGE:.0%}: {need}, or use a wider lens")

    def see(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image [480, 480, 3] with INTRINSICS_PX. Raises SaccadeError if `rgb` [H, W, 3] has another size."""
        if rgb.shape != (*self.size_px[::-1], 3):
            raise SaccadeError(f"an image of shape {list(rgb.shape)} among images of {self.size_px[0]}x"
                               f"{self.size_px[1]} pixels: all must come from one camera")
        return self._resampling.of(rgb, FILL)
