"""The lens that a file of poses tells of: its intrinsics, and how much it distorts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from saccade.services.camera.trajectories.distortion import distorted, undistorted
from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import Array
from saccade.shared.world.images import Size
from saccade.shared.world.photographs import Intrinsics

MAX_SIDE_PX, MIN_FOCAL_PX, MAX_FOCAL_PX = 100_000, 1.0, 1e7
MAX_SHIFT_PX = 1e5  # a larger one is not told as a number
SAME_SHAPE = 0.01  # largest difference of width / height between the file's images and the source's
LARGEST_SPREAD = 0.05  # of the focal lengths within a file, as a share: a phone's autofocus stays within it
TOLD_SPREAD = 1e-3  # of the focal lengths; beyond it the user is told that the median is used


@dataclass(frozen=True)
class Lens:
    """A camera's lens.

    `intrinsics_px` are (fx, fy, cx, cy), counted from the corner of the first pixel of an image of `size_px` (width,
    height). If a file tells neither focal length nor size, `angle_x_rad` is the horizontal field of view.
    `distortion` holds OpenCV's coefficients by name (k1 to k6, p1, p2), or those of its fisheye model.
    """

    intrinsics_px: Intrinsics | None
    size_px: Size | None = None
    distortion: tuple[tuple[str, float], ...] = ()
    fisheye: bool = False
    angle_x_rad: float | None = None

    @property
    def distorts(self) -> bool:
        """Whether the lens differs from a pinhole."""
        return self.fisheye or any(value for _, value in self.distortion)

    def of(self, size_px: Size, told_by: str = "the poses' file") -> Intrinsics:
        """The intrinsics for images of `size_px`. Raises SaccadeError if those images have another shape."""
        if self.intrinsics_px is None:
            focal = size_px[0] / 2 / math.tan((self.angle_x_rad or 1.0) / 2)
            return focal, focal, size_px[0] / 2, size_px[1] / 2
        width, height = self.size_px or size_px
        if abs(size_px[0] * height / (size_px[1] * width) - 1) > SAME_SHAPE:
            raise SaccadeError(f"the intrinsics of {told_by} are for images of {width}x{height} pixels, the source has "
                               f"{size_px[0]}x{size_px[1]}: give camera.intrinsics_px, or images of that shape")
        x, y = size_px[0] / width, size_px[1] / height
        fx, fy, cx, cy = self.intrinsics_px
        return fx * x, fy * y, cx * x, cy * y

    def at(self, size_px: Size, told_by: str = "the poses' file") -> Lens:
        """The same lens for images of `size_px`. Raises SaccadeError as `of` does."""
        return Lens(self.of(size_px, told_by), size_px, self.distortion, self.fisheye)

    def pixels(self, rays: Array) -> Array:
        """Pixels [N, 2] where the lens shows rays (x, y) [N, 2] at depth 1, y down. The intrinsics must be known."""
        fx, fy, cx, cy = self._known
        return distorted(rays, dict(self.distortion), fisheye=self.fisheye) * (fx, fy) + (cx, cy)

    def rays(self, pixels: Array) -> Array:
        """Rays (x, y) [N, 2] at depth 1, y down, that the lens shows at pixels [N, 2]. NaN where it shows none. The
        intrinsics must be known."""
        fx, fy, cx, cy = self._known
        return undistorted((pixels - (cx, cy)) / (fx, fy), dict(self.distortion), fisheye=self.fisheye)

    @property
    def _known(self) -> Intrinsics:
        if self.intrinsics_px is None:
            raise ValueError("a lens without intrinsics: give it an image size with `at`")
        return self.intrinsics_px

    def corner_px(self) -> float:
        """How far the distortion moves a pixel at the image's corners, at most (pixels). It may be infinite."""
        if self.intrinsics_px is None:
            return 0.0
        fx, fy, cx, cy = self.intrinsics_px
        width, height = self.size_px or (2 * cx, 2 * cy)
        corners = np.array([[u, v] for u in (0.0, width) for v in (0.0, height)])
        rays = (corners - (cx, cy)) / (fx, fy)
        with np.errstate(all="ignore"):  # a polynomial of wrong coefficients goes anywhere
            moved = np.linalg.norm(self.pixels(rays) - corners, axis=1)
        return float(moved.max()) if np.isfinite(moved).all() else math.inf

    def note(self) -> str | None:
        """What the distortion is, in words, or None if there is none."""
        if not self.distorts:
            return None
        kind = "the fisheye distortion" if self.fisheye else "the distortion"
        told = ", ".join(f"{name} {value:g}" for name, value in self.distortion if value)
        corner_px = self.corner_px()
        size = f"up to {corner_px:.1f} pixels" if corner_px < MAX_SHIFT_PX else f"more than {MAX_SHIFT_PX:.0f} pixels"
        if self.intrinsics_px is None:
            size = "by an unknown number of pixels"
        return f"{kind} of the lens{f' ({told})' if told else ''}, {size} at the image's corner"


def lens(numbers: Mapping[str, float], size_px: tuple[float, float] | None = None, *, fisheye: bool = False) -> Lens:
    """The lens of fx, fy, cx, cy and coefficients by name. Raises ValueError if no lens has such numbers."""
    fx, fy, cx, cy = (float(numbers[name]) for name in ("fx", "fy", "cx", "cy"))
    distortion = tuple((name, float(value)) for name, value in numbers.items() if name not in ("fx", "fy", "cx", "cy"))
    if not np.isfinite([fx, fy, cx, cy, *(value for _, value in distortion)]).all():
        raise ValueError("the intrinsics are not finite: export the cameras again, or give camera.intrinsics_px")
    if not (min(fx, fy) >= MIN_FOCAL_PX and max(fx, fy, abs(cx), abs(cy)) <= MAX_FOCAL_PX):
        raise ValueError(f"no camera has the intrinsics ({fx:g}, {fy:g}, {cx:g}, {cy:g}) px: export the cameras again")
    return Lens((fx, fy, cx, cy), None if size_px is None else _size(*size_px), distortion, fisheye)


def _size(width: float, height: float) -> Size:
    if not all(math.isfinite(side) and 1 <= side <= MAX_SIDE_PX for side in (width, height)):
        raise ValueError(f"no image has {width:g}x{height:g} pixels: export the cameras again")
    return int(width), int(height)


def one_lens(lenses: Sequence[Lens]) -> tuple[Lens | None, str | None]:
    """One lens for all frames: their median, and a note if they differ. Raises SaccadeError if they are those of
    several cameras."""
    different = list(dict.fromkeys(lenses))
    if len(different) < 2:
        return (different[0] if different else None), None
    shapes = {(x.size_px, x.fisheye, x.intrinsics_px is None) for x in different}
    numbers = np.array([x.intrinsics_px for x in lenses if x.intrinsics_px is not None])
    if len(shapes) > 1 or len(numbers) != len(lenses):
        raise SaccadeError("the poses are those of several cameras: give those of one, or camera.intrinsics_px")
    low, high = float(numbers[:, 0].min()), float(numbers[:, 0].max())
    spread = (high - low) / low
    if spread > LARGEST_SPREAD:
        raise SaccadeError(f"the poses' focal lengths go from {low:.0f} to {high:.0f} px: give the poses of one "
                           "camera, or camera.intrinsics_px")
    fx, fy, cx, cy = map(float, np.median(numbers, axis=0))
    first = min(lenses, key=lambda x: abs(x.intrinsics_px[0] - fx) if x.intrinsics_px else math.inf)
    note = f"the focal length goes from {low:.1f} to {high:.1f} px: the median is used"
    median = Lens((fx, fy, cx, cy), first.size_px, first.distortion, first.fisheye)
    return median, note if spread > TOLD_SPREAD else None
