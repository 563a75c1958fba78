"""COLMAP's cameras and images, as text: `images.txt` and `cameras.txt`.

The poses are camera_from_world: a quaternion w x y z and a translation, in OpenCV camera axes. Nothing but the
reconstruction fixes the world's axes, its origin and its unit.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from saccade.services.camera.trajectories.lens import Lens, lens
from saccade.services.camera.trajectories.rigid import from_quaternion
from saccade.services.camera.trajectories.text import MAX_LINE, MAX_POSES, within
from saccade.services.camera.trajectories.trajectory import Asked, Key, Order, Stored
from saccade.shared.errors import SaccadeError, printable, told
from saccade.shared.files import MIB, opened, size_of
from saccade.shared.world.geometry import Array

MAX_IMAGES_BYTES, MAX_CAMERAS_BYTES = 1024 * MIB, 4 * MIB  # an images file holds all points that each image shows
MAX_CAMERAS = 10_000
MAX_POINTS_BYTES = 32 * MIB  # of the line with the points of one image
NEED = "give the images.txt or images.bin of a COLMAP model, with its cameras file beside it"
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
MODELS: dict[str, tuple[str, ...]] = {  # COLMAP's numbers of the models are their places in this table
    "SIMPLE_PINHOLE": ("f", "cx", "cy"), "PINHOLE": ("fx", "fy", "cx", "cy"), "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"), "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "FOV": (),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"), "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2")}


@dataclass(frozen=True)
class Registered:
    """An image of a COLMAP model: its name, its camera's number, and its pose camera_from_world [4, 4]."""

    name: str
    camera: int
    camera_from_world: Array


def camera_lens(model: str, width: float, height: float, parameters: Sequence[float]) -> Lens:
    """The lens of a COLMAP camera. Raises ValueError if the model is not read or has other parameters."""
    names = MODELS.get(model, ())
    if not names:
        raise ValueError(f"the camera model {told(model)} is not read: undistort the images with COLMAP's "
                         "image_undistorter first")
    if len(parameters) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters ({', '.join(names)}), not {len(parameters)}")
    numbers = dict(zip(names, parameters, strict=True))
    if "f" in numbers:
        numbers["fx"] = numbers["fy"] = numbers.pop("f")
    return lens(numbers, (width, height), fisheye=model in FISHEYE)


def stored(path: Path, images: list[Registered], lenses: dict[int, Lens] | None, order: Order) -> Stored:
    """The poses of a model's images. `lenses` are None if there is no cameras file. Raises SaccadeError if there is no
    image, if two have one name, or if an image is of an unknown camera."""
    if not images:
        raise SaccadeError(f"poses {path} holds no pose: {NEED}")
    table: dict[Key, Array] = {}
    for image in images:
        with within(path, ""):
            key: Key = ("image", image.name.replace("\\", "/").rsplit("/", 1)[-1])
            if key in table:
                raise ValueError(f"a second pose for image {printable(str(key[1]), 100)}: give the model of one folder "
                                 "of images")
            if lenses is not None and image.camera not in lenses:
                raise ValueError(f"image {told(image.name)} is of camera {image.camera}, which the cameras file does "
                                 f"not have: {NEED}")
        table[key] = image.camera_from_world
    notes = ("no cameras file lies beside it: the intrinsics are not known",) if lenses is None else ()
    of_images = [lenses[image.camera] for image in images] if lenses else []
    different = list(dict.fromkeys(of_images))
    return Stored("colmap", tuple(table), np.stack(list(table.values())), direction="camera_from_world", up=None,
                  quaternion=order, lenses=tuple(different if len(different) == 1 else of_images), notes=notes,
                  metric=False)


def read_colmap_text(path: Path, asked: Asked) -> Stored:
    """Reads images.txt, and cameras.txt beside it. Raises SaccadeError with file:line if a line is damaged."""
    order = asked.quaternion or "wxyz"
    cameras = path.with_name("cameras.txt")
    lenses = dict(_cameras(cameras)) if os.path.exists(cameras) else None
    return stored(path, list(_images(path, order)), lenses, order)


def _lines(path: Path, limit: int) -> Iterator[tuple[int, str, bool]]:
    """Each line with its number, and whether it is cut: the points of an image make long lines that nobody needs."""
    with opened(path, "poses", NEED, limit) as stream:
        for number in count(1):
            line = stream.readline(MAX_POINTS_BYTES + 1)
            if not line:
                break
            if len(line) > MAX_POINTS_BYTES:
                raise SaccadeError(f"poses {path}:{number}: a line of more than {size_of(MAX_POINTS_BYTES)}: {NEED}")
            try:
                text = line[:MAX_LINE].decode("utf-8", "strict" if len(line) <= MAX_LINE else "ignore")
            except UnicodeDecodeError as error:
                raise SaccadeError(f"poses {path} is not a text in UTF-8 (line {number}): {NEED}") from error
            yield number, text.removeprefix("\ufeff").strip(), len(line) > MAX_LINE


def _cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    found = 0
    for number, line, cut in _lines(path, MAX_CAMERAS_BYTES):
        if not line or line.startswith("#"):
            continue
        with within(path, f":{number}"):
            found += 1
            if found > MAX_CAMERAS or cut:
                raise ValueError(f"more than {MAX_CAMERAS} cameras or {MAX_LINE} characters in a line: {NEED}")
            words = line.split()
            try:
                camera, width, height, *parameters = [float(word) for word in (words[0], *words[2:])]
            except (IndexError, ValueError):
                raise ValueError("not a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS, with numbers") from None
            yield int(camera), camera_lens(words[1], width, height, parameters)


def _images(path: Path, order: Order) -> Iterator[Registered]:
    """Every image has two lines, of which the second holds its points and may be empty."""
    points = False
    found = 0
    for number, line, cut in _lines(path, MAX_IMAGES_BYTES):
        if points:
            points = False
            if not cut and len(line.split()) % 3:
                raise SaccadeError(f"poses {path}:{number}: not the points of an image, X Y POINT3D_ID each: every "
                                   "image has two lines, of which the second may be empty")
            continue
        if not line or line.startswith("#"):
            continue
        found += 1
        with within(path, f":{number}"):
            if found > MAX_POSES:
                raise ValueError(f"more than {MAX_POSES} poses: leave out what no image needs")
            if cut:
                raise ValueError(f"a line of more than {MAX_LINE} characters: {NEED}")
            yield _image(line, order)
        points = True


def _image(line: str, order: Order) -> Registered:
    words = line.split(maxsplit=9)
    try:
        _, *pose, camera = [float(word) for word in words[:9]]
        name = words[9]
        identifier = int(camera)
    except (IndexError, ValueError, OverflowError):
        raise ValueError("not an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; every image has two lines, of "
                         "which the second may be empty") from None
    return Registered(name, identifier, from_quaternion(pose[4:], pose[:4], order))
