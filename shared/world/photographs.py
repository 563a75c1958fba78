"""Reads photographs: PNG or JPEG files of any size and mode, upright, as RGB, with the intrinsics of their camera.

Pixels are counted from the corner of the first pixel of the upright picture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError
from saccade.shared.world.exif import FIRST_TURNED, UPRIGHT, Exif, exif_of
from saccade.shared.world.images import Size, opened_image

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy in pixels

NEED = "give a whole PNG or JPEG"
MIN_SIDE_PX, MAX_RATIO = 32, 8  # of a picture's sides: nothing is recognised in a smaller or a narrower one
FIELD_OF_VIEW_RAD = math.radians(60)  # horizontal, if nothing is known
FOCAL_SIDES = (0.1, 100.0)  # limits of a focal length, in longer sides: fields of view from 157 to 0.6 degrees
CENTRAL = (-2.0, 3.0)  # limits of the principal point, as shares of the side; it lies outside where a picture was cut


@dataclass(frozen=True)
class Photograph:
    """An upright photograph. `rgb` [H, W, 3] of uint8 may have been made smaller; `size_px` (width, height) is the size
    of the file's picture. `intrinsics_px` are those of `rgb`, and `told` says in words where they are from."""

    path: Path
    rgb: NDArray[np.uint8]
    size_px: Size
    intrinsics_px: Intrinsics
    told: str
    assumed: bool


def read_photograph(path: Path, intrinsics_px: Sequence[float] | None = None, *, longest_px: int,
                    what: str = "photograph") -> Photograph:
    """Reads a photograph, and makes it smaller if one of its sides is longer than `longest_px`.

    `intrinsics_px` (fx, fy, cx, cy) are those of the whole upright picture. Without them the EXIF data tell the focal
    length, else a horizontal field of view of 60 degrees is assumed. What is transparent becomes black. Raises
    SaccadeError, which begins with `what`, if the file is no whole PNG or JPEG, if it is too large or too small, or if
    the intrinsics cannot be its own.
    """
    with opened_image(path, what, NEED) as image:
        exif = exif_of(image)
        size_px = (image.size[1], image.size[0]) if exif.orientation >= FIRST_TURNED else image.size
        if min(size_px) < MIN_SIDE_PX or max(size_px) > MAX_RATIO * min(size_px):
            raise SaccadeError(f"{what} {path} is {size_px[0]}x{size_px[1]} pixels: give one of at least {MIN_SIDE_PX} "
                               f"pixels on each side, and at most {MAX_RATIO} times as long on one as on the other")
        whole_px, told, assumed = _intrinsics(path, what, size_px, intrinsics_px, exif)
        picture = _reduced(image, longest_px)
        if exif.orientation in UPRIGHT:
            picture = picture.transpose(UPRIGHT[exif.orientation])
        rgb = np.array(picture)
    return Photograph(path, rgb, size_px, scaled(whole_px, size_px, (rgb.shape[1], rgb.shape[0])), told, assumed)


def scaled(intrinsics_px: Intrinsics, old_px: Size, new_px: Size) -> Intrinsics:
    """The intrinsics of a picture after its size (width, height) was changed."""
    x, y = new_px[0] / old_px[0], new_px[1] / old_px[1]
    fx, fy, cx, cy = intrinsics_px
    return fx * x, fy * y, cx * x, cy * y


def _intrinsics(path: Path, what: str, size_px: Size, given: Sequence[float] | None,
                exif: Exif) -> tuple[Intrinsics, str, bool]:
    """The intrinsics of the whole picture, where they are from, and whether they are assumed."""
    width, height = size_px
    if given is not None:
        fx, fy, cx, cy = given
        if not (_is_focal(fx, size_px) and _is_focal(fy, size_px)
                and all(CENTRAL[0] <= share <= CENTRAL[1] for share in (cx / width, cy / height))):
            raise SaccadeError(f"intrinsics ({fx:g}, {fy:g}, {cx:g}, {cy:g}) px cannot be those of {what} {path} of "
                               f"{width}x{height} pixels: give fx,fy,cx,cy of the whole upright picture")
        return (fx, fy, cx, cy), "the intrinsics are those that you gave", False
    if exif.focal_px is not None and _is_focal(exif.focal_px, size_px):
        focal, assumed = exif.focal_px, False
        told = f"the focal length is from its EXIF data ({exif.focal_told})"
    else:
        focal, assumed = width / 2 / math.tan(FIELD_OF_VIEW_RAD / 2), True
        told = (f"the intrinsics are not known, and a horizontal field of view of "
                f"{math.degrees(FIELD_OF_VIEW_RAD):.0f} degrees is assumed")
    return (focal, focal, width / 2, height / 2), told, assumed


def _is_focal(focal_px: float, size_px: Size) -> bool:
    return FOCAL_SIDES[0] <= focal_px / max(size_px) <= FOCAL_SIDES[1]  # false for NaN


def _reduced(image: Image.Image, longest_px: int) -> Image.Image:
    """The picture in RGB with sides of at most `longest_px`. It is made smaller before it is converted, which takes
    less memory."""
    if max(image.size) > longest_px:
        share = longest_px / max(image.size)
        # Of a JPEG this decodes fewer pixels; for others it does nothing.
        image.draft(image.mode, (math.ceil(image.width * share), math.ceil(image.height * share)))
    image = _plain(image)
    if max(image.size) >= 2 * longest_px:
        image = image.reduce(max(image.size) // longest_px)
    if image.has_transparency_data:
        image = Image.alpha_composite(Image.new("RGBA", image.size, "black"), image.convert("RGBA"))
    image = image.convert("RGB")
    if max(image.size) > longest_px:
        share = longest_px / max(image.size)
        image = image.resize((max(1, round(image.width * share)), max(1, round(image.height * share))),
                             Image.Resampling.BILINEAR)
    return image


def _plain(image: Image.Image) -> Image.Image:
    """The picture in a mode whose numbers are shares of a light, with 8 bits: not a palette, and not one bit or 16."""
    if image.mode.startswith(("I", "F")):
        return Image.fromarray((np.asarray(image).astype(np.int64).clip(0, 65535) >> 8).astype(np.uint8))
    if image.mode == "P" or "transparency" in image.info:
        return image.convert("RGBA" if image.has_transparency_data else "RGB")
    return image.convert("L") if image.mode == "1" else image
