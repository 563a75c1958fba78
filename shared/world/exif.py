"""What a photograph says of itself (EXIF): how it is turned, and the focal length of its lens. Damaged data say
nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

Transposition = Image.Transpose
UPRIGHT = {2: Transposition.FLIP_LEFT_RIGHT, 3: Transposition.ROTATE_180, 4: Transposition.FLIP_TOP_BOTTOM,
           5: Transposition.TRANSPOSE, 6: Transposition.ROTATE_270, 7: Transposition.TRANSVERSE,
           8: Transposition.ROTATE_90}  # by the tag Orientation; 1 is upright already
FIRST_TURNED = 5  # from this orientation on, width and height are exchanged
FILM_DIAGONAL_MM = 43.2666  # of 36x24 mm; a focal length "in 35 mm film" compares diagonals (CIPA DCG-001)
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # by the tag FocalPlaneResolutionUnit
INCH = 2  # the unit if none is named


@dataclass(frozen=True)
class Exif:
    """`orientation` is from 1 to 8. `focal_px` is the focal length in pixels of the whole picture, None if it is not
    known, and `focal_told` says in words where it is from."""

    orientation: int = 1
    focal_px: float | None = None
    focal_told: str = ""


def exif_of(image: Image.Image) -> Exif:
    """Reads the EXIF data of an open picture. Raises what Pillow raises if the pixels of a PNG are damaged."""
    if image.format == "PNG":
        image.load()  # which may say it after its pixels
    try:
        tags = image.getexif()
        orientation, inner = tags.get(ExifTags.Base.Orientation), tags.get_ifd(ExifTags.IFD.Exif)
    except Exception:  # Pillow raises many kinds for damaged data, and a picture is whole without them
        return Exif()
    focal = _film_focal(inner, image.size) or _sensor_focal(inner, image.size) or (None, "")
    return Exif(orientation if orientation in UPRIGHT else 1, *focal)


def _film_focal(tags: Mapping[int, Any], size_px: tuple[int, int]) -> tuple[float, str] | None:
    film_mm = _positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if film_mm is None:
        return None
    return film_mm * math.hypot(*size_px) / FILM_DIAGONAL_MM, f"{film_mm:g} mm in 35 mm film"


def _sensor_focal(tags: Mapping[int, Any], size_px: tuple[int, int]) -> tuple[float, str] | None:
    focal_mm = _positive(tags.get(ExifTags.Base.FocalLength))
    per_unit = _positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = UNIT_MM.get(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, INCH))
    if focal_mm is None or per_unit is None or unit_mm is None:
        return None
    taken_px = _positive(tags.get(ExifTags.Base.ExifImageWidth)) or size_px[0]  # it may have been made smaller since
    return focal_mm * per_unit / unit_mm * size_px[0] / taken_px, f"{focal_mm:g} mm on its sensor"


def _positive(value: Any) -> float | None:
    """The number, or None if it is missing, zero (which means unknown) or no number."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
