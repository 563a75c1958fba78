"""Images that a user gives: whole PNG or JPEG files in RGB; what is not is refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import IMAGE_SIZE_PX

Size = tuple[int, int]  # width and height in pixels

_NEED = "give a PNG or JPEG in RGB"
_FIRST_TURNED = 5  # of the EXIF orientations that exchange width and height


def read_image(path: Path, *, what: str = "image", need: str = _NEED) -> NDArray[np.uint8]:
    """The image [H, W, 3]; a JPEG upright as its EXIF orientation says.

    Raises SaccadeError, which begins with `what` and ends with `need`, unless it is a whole PNG or JPEG in RGB.
    """
    with _opened(path, what, need) as image:
        return np.array(ImageOps.exif_transpose(image) if image.format == "JPEG" else image)


def image_size(path: Path, *, what: str = "image", need: str = _NEED) -> Size:
    """Width and height (pixels) of the upright image, from its header alone. Raises SaccadeError as `read_image`."""
    with _opened(path, what, need) as image:
        if image.format == "JPEG" and image.getexif().get(ExifTags.Base.Orientation, 1) >= _FIRST_TURNED:
            return image.size[::-1]
        return image.size


def read_goal_image(path: Path) -> NDArray[np.uint8]:
    """The user's goal image [480, 480, 3]. Raises SaccadeError unless it is a whole PNG or JPEG in RGB of that size."""
    need = f"give a PNG or JPEG of {IMAGE_SIZE_PX}x{IMAGE_SIZE_PX} pixels in RGB"
    width, height = image_size(path, what="goal image", need=need)
    if (width, height) != (IMAGE_SIZE_PX, IMAGE_SIZE_PX):
        raise SaccadeError(f"goal image {path} is {width}x{height} pixels: {need}")
    return read_image(path, what="goal image", need=need)


@contextmanager
def _opened(path: Path, what: str, need: str) -> Iterator[Image.Image]:
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            if image.mode != "RGB":
                raise SaccadeError(f"{what} {path} has mode {image.mode}, not RGB: {need}")
            yield image
    except UnidentifiedImageError as error:
        raise SaccadeError(f"{what} {path} is neither PNG nor JPEG: {need}") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:  # a damaged PNG: SyntaxError
        raise SaccadeError(f"{what} {path} cannot be read ({error}): {need}") from error
