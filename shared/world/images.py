"""Reads images that a user gives: whole PNG or JPEG files in RGB. Other files are refused with a message of one
line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, opened

Size = tuple[int, int]  # width and height in pixels

MAX_FILE_BYTES = 128 * MIB
MAX_PIXELS = 64 * MIB  # such as 8192x8192; decoded, an image takes three times as many bytes

_NEED = "give a PNG or JPEG in RGB"
_FIRST_TURNED = 5  # from this EXIF orientation on, width and height are exchanged


def read_image(path: Path, *, what: str = "image", need: str = _NEED) -> NDArray[np.uint8]:
    """Returns the image [H, W, 3] of uint8. A JPEG (or MPO, a JPEG with several pictures) is turned upright
    as its EXIF orientation says.

    Raises SaccadeError, which begins with `what` and ends with `need`, if the file is not a whole PNG or JPEG in RGB.
    """
    with _opened_rgb(path, what, need) as image:
        return np.array(upright(image))


def upright(image: Image.Image) -> Image.Image:
    """A JPEG, turned as its EXIF orientation says; another image as it is."""
    return ImageOps.exif_transpose(image) if image.format != "PNG" else image


def image_size(path: Path, *, what: str = "image", need: str = _NEED) -> Size:
    """Returns width and height in pixels of the upright image, from its header alone. Raises SaccadeError like
    `read_image`."""
    with _opened_rgb(path, what, need) as image:
        if image.format != "PNG" and image.getexif().get(ExifTags.Base.Orientation, 1) >= _FIRST_TURNED:
            return image.size[::-1]
        return image.size


@contextmanager
def _opened_rgb(path: Path, what: str, need: str) -> Iterator[Image.Image]:
    """Does the same as `opened_image`, but accepts images in RGB only."""
    with opened_image(path, what, need) as image:
        if image.mode != "RGB":
            raise SaccadeError(f"{what} {path} has mode {image.mode}, not RGB: {need}")
        yield image


@contextmanager
def opened_image(path: Path, what: str, need: str) -> Iterator[Image.Image]:
    """Opens a PNG or JPEG of any mode and reads its header. Raises SaccadeError if it is another kind of file or too
    large, and also if reading its pixels fails within the context."""
    with opened(path, what, need, MAX_FILE_BYTES) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # broken EXIF data does no harm
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(stream, formats=("PNG", "JPEG")) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise SaccadeError(f"{what} {path} has {width}x{height} pixels, more than {MAX_PIXELS}: {need}")
                yield image
        except SaccadeError:
            raise
        except UnidentifiedImageError as error:
            raise SaccadeError(f"{what} {path} is neither PNG nor JPEG: {need}") from error
        except Exception as error:  # Pillow raises many kinds for images that are damaged or made to harm
            raise SaccadeError(f"{what} {path} cannot be read ({error or type(error).__name__}): {need}") from error
