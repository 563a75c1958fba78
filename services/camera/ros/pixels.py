"""Turns the images of ROS messages into RGB."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError, printable
from saccade.shared.ros.types import COMPRESSED, RosError
from saccade.shared.world.images import MAX_PIXELS

Pixels = NDArray[np.uint8]

NAME_LIMIT = 40  # characters of an encoding that is not known
MAX_REASON = 100


def _converted(name: str) -> Callable[[Pixels], Pixels]:
    """A conversion of OpenCV, which is loaded when the first image needs it."""
    def convert(pixels: Pixels) -> Pixels:
        try:
            import cv2
        except ImportError as error:
            raise SaccadeError(f"images in a Bayer pattern and in YUV need OpenCV ({error}): "
                               "pip install 'saccade[camera]'") from error
        cv2.setNumThreads(1)  # every service uses one thread
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, name)), dtype=np.uint8)
    return convert


def _swapped(pixels: Pixels) -> Pixels:
    """RGB of pixels whose first three channels are BGR. Channel by channel, which takes half as long as at once."""
    rgb = np.empty((*pixels.shape[:2], 3), np.uint8)
    for channel in range(3):
        rgb[..., channel] = pixels[..., 2 - channel]
    return rgb


def _grey(pixels: Pixels) -> Pixels:
    return np.repeat(pixels[..., None] if pixels.ndim == 2 else pixels, 3, axis=2)


ENCODINGS: dict[str, tuple[int, Callable[[Pixels], Pixels]]] = {  # bytes per pixel, and how they become RGB
    "rgb8": (3, lambda pixels: pixels), "bgr8": (3, _swapped), "8UC3": (3, _swapped),
    "rgba8": (4, lambda pixels: pixels[..., :3]), "bgra8": (4, _swapped),
    "mono8": (1, _grey), "8UC1": (1, _grey),
    "bayer_rggb8": (1, _converted("COLOR_BayerRGGB2RGB")), "bayer_bggr8": (1, _converted("COLOR_BayerBGGR2RGB")),
    "bayer_gbrg8": (1, _converted("COLOR_BayerGBRG2RGB")), "bayer_grbg8": (1, _converted("COLOR_BayerGRBG2RGB")),
    "yuyv": (2, _converted("COLOR_YUV2RGB_YUY2")), "yuv422_yuy2": (2, _converted("COLOR_YUV2RGB_YUY2")),
    "uyvy": (2, _converted("COLOR_YUV2RGB_UYVY")), "yuv422": (2, _converted("COLOR_YUV2RGB_UYVY")),
}


def rgb_of(kind: str, message: Any) -> Pixels:
    """The image [H, W, 3] of an Image or a CompressedImage. Raises RosError if its encoding is not known, or if it is
    not whole."""
    return _uncompressed(bytes(message.data)) if kind == COMPRESSED else _raw(message)


def _raw(message: Any) -> Pixels:
    if message.encoding not in ENCODINGS:
        raise RosError(f"the encoding '{printable(message.encoding, NAME_LIMIT)}' is not known; known are "
                       f"{', '.join(ENCODINGS)}")
    size, convert = ENCODINGS[message.encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise RosError(f"no image has {width}x{height} pixels")
    if step < width * size or len(message.data) < step * (height - 1) + width * size:
        raise RosError(f"{len(message.data)} bytes in rows of {step} are no {width}x{height} pixels of "
                       f"{message.encoding}")
    if (message.encoding.startswith("bayer") and min(width, height) < 3) or (size == 2 and width % 2):
        raise RosError(f"no image of {message.encoding} has {width}x{height} pixels")
    data = np.asarray(message.data, dtype=np.uint8)
    pixels = np.lib.stride_tricks.as_strided(data, (height, width, size), (step, size, 1), writeable=False)
    return np.ascontiguousarray(convert(pixels[..., 0] if size == 1 else pixels))


def _uncompressed(data: bytes) -> Pixels:
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise RosError(f"an image of {image.width}x{image.height} pixels is too large")
                if image.mode not in ("RGB", "RGBA", "L", "P"):
                    raise RosError(f"an image of mode {image.mode} is neither in colour nor grey with 8 bits")
                return np.array(image if image.mode == "RGB" else image.convert("RGB"))
        except RosError:
            raise
        except Exception as error:  # Pillow raises many kinds for images that are damaged or made to harm
            raise RosError("it is no whole JPEG or PNG "
                           f"({printable(_reason(error), MAX_REASON)})") from error


def _reason(error: Exception) -> str:
    """What Pillow says, without the names of objects in memory."""
    said = re.sub(r"\s*<[^>]*>", "", str(error))
    return said or type(error).__name__
