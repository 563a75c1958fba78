"""COLMAP's cameras and images in its binary format: `images.bin` and `cameras.bin`. Points are skipped, not read."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from saccade.services.camera.trajectories.colmap import (
    MAX_CAMERAS,
    MAX_CAMERAS_BYTES,
    MAX_IMAGES_BYTES,
    MODELS,
    NEED,
    Registered,
    camera_lens,
    stored,
)
from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.trajectories.rigid import from_quaternion
from saccade.services.camera.trajectories.text import MAX_POSES, within
from saccade.services.camera.trajectories.trajectory import Asked, Order, Stored
from saccade.shared.files import opened

_COUNT, _IMAGE, _CAMERA = struct.Struct("<Q"), struct.Struct("<I7dI"), struct.Struct("<IiQQ")
_POINT_BYTES = 24  # x and y as doubles, and the number of the point
MAX_NAME = 1024
_CUT = f"the file ends too early: copy it again, whole, or {NEED}"


def read_colmap_binary(path: Path, asked: Asked) -> Stored:
    """Reads images.bin, and cameras.bin beside it. Raises SaccadeError, which names the image, if one is damaged."""
    order = asked.quaternion or "wxyz"
    cameras = path.with_name("cameras.bin")
    lenses = dict(_cameras(cameras)) if os.path.exists(cameras) else None
    with opened(path, "poses", NEED, MAX_IMAGES_BYTES) as stream:
        images = list(_images(path, stream, order))
    return stored(path, images, lenses, order)


def _read(stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise ValueError(_CUT)
    return data


def _count(stream: BinaryIO, limit: int) -> int:
    count, = _COUNT.unpack(_read(stream, _COUNT.size))
    if count > limit:
        raise ValueError(f"it tells of {count} entries, more than {limit}: {NEED}")
    return count


def _cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    with opened(path, "poses", NEED, MAX_CAMERAS_BYTES) as stream:
        with within(path, ""):
            count = _count(stream, MAX_CAMERAS)
        for k in range(count):
            with within(path, f", camera {k}"):
                camera, model, width, height = _CAMERA.unpack(_read(stream, _CAMERA.size))
                name = list(MODELS)[model] if 0 <= model < len(MODELS) else f"number {model}"
                size = 8 * len(MODELS.get(name, ()))
                yield camera, camera_lens(name, width, height, struct.unpack(f"<{size // 8}d", _read(stream, size)))


def _images(path: Path, stream: BinaryIO, order: Order) -> Iterator[Registered]:
    size = os.fstat(stream.fileno()).st_size
    with within(path, ""):
        count = _count(stream, MAX_POSES)
    for k in range(count):
        with within(path, f", image {k}"):
            _, *pose, camera = _IMAGE.unpack(_read(stream, _IMAGE.size))
            name = _name(stream)
            points, = _COUNT.unpack(_read(stream, _COUNT.size))
            if points * _POINT_BYTES > size - stream.tell():
                raise ValueError(_CUT)
            stream.seek(points * _POINT_BYTES, os.SEEK_CUR)
            yield Registered(name, camera, from_quaternion(pose[4:], pose[:4], order))
    if stream.read(1):
        with within(path, ""):
            raise ValueError(f"more follows after its {count} images: {NEED}")


def _name(stream: BinaryIO) -> str:
    """A name that ends with a zero."""
    start = stream.tell()
    found, zero, _ = stream.read(MAX_NAME).partition(b"\0")
    if not zero:
        raise ValueError(f"the name of the image has no end: copy the file again, whole, or {NEED}")
    stream.seek(start + len(found) + 1)
    try:
        return found.decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"the name of the image is not UTF-8: {NEED}") from error
