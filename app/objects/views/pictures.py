"""Reads the pictures around an object: those of a folder or the frames of a video, with the camera's poses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates

from saccade.services.camera.poses import Poses, read_poses
from saccade.services.camera.sources import SourceImage, Video, image_paths, is_live
from saccade.services.camera.trajectories.distortion import widest
from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.trajectories.trajectory import ORIGIN_NOTE, Asked
from saccade.shared.errors import SaccadeError
from saccade.shared.world.exif import exif_of
from saccade.shared.world.geometry import Array
from saccade.shared.world.images import Size, opened_image, upright
from saccade.shared.world.photographs import Intrinsics, scaled

LONGEST_PX = 1280  # to which a picture is made smaller
MOST = 120  # pictures that are used
MOST_FRAMES = 20_000  # of a video
RATE_HZ = 10.0  # of a folder whose poses have times
MODES = ("RGB", "RGBA", "L", "LA", "P", "CMYK")  # of eight bits for each channel
NEED = "give whole PNG or JPEG files of 8 bits"


@dataclass(frozen=True)
class Picture:
    """rgb [H, W, 3] uint8 of a pinhole camera with `intrinsics_px` at world_from_camera [4, 4] (OpenGL). `mask` [H, W]
    says what belongs to the object, if the file has an alpha channel. `places` [2, H, W] are the rows and columns of
    the pixels before the distortion of the lens was removed, None if it had none."""

    name: str
    rgb: NDArray[np.uint8]
    intrinsics_px: Intrinsics
    world_from_camera: Array
    mask: NDArray[np.bool_] | None = None
    places: NDArray[np.float32] | None = None


@dataclass
class Told:
    """What the user gives beside the pictures, and what was taken, a line each."""

    poses: Path
    intrinsics_px: Intrinsics | None = None
    asked: Asked = field(default_factory=Asked)
    notes: list[str] = field(default_factory=list)


def pictures_of(source: Path, told: Told) -> Iterator[Picture]:
    """Yields pictures that have a pose, evenly spread over all: at most MOST of a folder, and of a video more than
    that, because its length is not known before. Raises SaccadeError if the pictures or the poses cannot be read, if no
    picture has a pose, or if nothing tells the intrinsics."""
    if is_live(str(source)):
        raise SaccadeError(f"--views {source}: give a folder of pictures or a video; a camera cannot be asked twice")
    poses = read_poses(told.poses, asked=told.asked)
    told.notes += [_by_options(note) for note in poses.notes if note != ORIGIN_NOTE]
    try:
        if os.path.isdir(source):
            yield from _of_folder(source, poses, told)
        elif os.path.isfile(source):
            yield from _of_video(source, poses, told)
        else:
            raise SaccadeError(f"--views {source} is not there: give a folder of pictures or a video")
    except SaccadeError as error:
        raise SaccadeError(_by_options(str(error))) from error


def _by_options(text: str) -> str:
    """What is told of keys of the configuration, told of this command's options."""
    for key, option in (("camera.intrinsics_px", "--intrinsics"), ("camera.poses_scale", "--scale"),
                        ("camera.poses_up", "--up")):
        text = text.replace(key, option)
    return text


def _of_folder(folder: Path, poses: Poses, told: Told) -> Iterator[Picture]:
    paths = image_paths(folder)
    poses = poses.matched([path.name for path in paths])
    nothing = np.zeros((0, 0, 3), dtype=np.uint8)
    images = [SourceImage(nothing, index, index / RATE_HZ, path.name) for index, path in enumerate(paths)]
    posed = [(path, matrix) for path, image in zip(paths, images, strict=True)
             if (matrix := poses.of(image)) is not None]
    if not posed:
        raise SaccadeError(f"none of the {len(paths)} pictures of {folder} ({images[0]} to {images[-1]}) has a pose in "
                           f"{poses}: {poses.advice}")
    if len(posed) < len(paths):
        told.notes.append(f"{len(paths) - len(posed)} of {len(paths)} pictures have no pose")
    straighten = _Straighten()
    for number in evenly(len(posed), MOST):
        path, matrix = posed[number]
        rgb, alpha, size_px, focal_px = read_picture(path)
        lens = _lens(poses, told, size_px, focal_px)
        yield straighten(Picture(path.name, rgb, _smaller(lens, size_px, rgb), matrix, alpha), lens)


def _of_video(path: Path, poses: Poses, told: Told) -> Iterator[Picture]:
    """The number of frames is not known before: at first each one is yielded, and the longer it lasts, the fewer."""
    video, straighten, stride, seen = Video(path), _Straighten(), 1, 0
    for image in video:
        if image.index >= MOST_FRAMES:
            raise SaccadeError(f"video {path} has more than {MOST_FRAMES} frames: cut it")
        matrix = poses.of(image)
        if matrix is None:
            continue
        if seen % stride == 0:
            rgb = np.asarray(_reduced(Image.fromarray(image.rgb)))
            lens = _lens(poses, told, video.size_px, None)
            yield straighten(Picture(f"frame {image.index}", rgb, _smaller(lens, video.size_px, rgb), matrix), lens)
        seen += 1
        if seen == 2 * MOST * stride:
            stride *= 2
    if not seen:
        raise SaccadeError(f"no frame of {path} ({video.size_px[0]}x{video.size_px[1]} pixels) has a pose in {poses}: "
                           f"{poses.advice}")


def evenly(count: int, most: int) -> list[int]:
    """At most so many numbers below `count`, evenly spread."""
    return list(range(count)) if count <= most else [round(k * (count - 1) / (most - 1)) for k in range(most)]


def read_picture(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None, Size, float | None]:
    """A picture's colours [H, W, 3], made smaller and upright, the mask of its alpha channel if it has one, its own
    size (width, height), and its focal length in pixels if its EXIF data tell it."""
    with opened_image(path, "picture", NEED) as image:
        if image.mode not in MODES:
            raise SaccadeError(f"picture {path} has mode {image.mode}: {NEED}")
        focal_px = exif_of(image).focal_px
        picture = upright(image)
        size_px = picture.size
        if picture.has_transparency_data:
            rgba = np.asarray(_reduced(picture.convert("RGBA")))
            mask = None if rgba[..., 3].min() == 255 else rgba[..., 3] > 127
            return np.ascontiguousarray(rgba[..., :3]), mask, size_px, focal_px
        return np.asarray(_reduced(picture.convert("RGB"))), None, size_px, focal_px


def _reduced(image: Image.Image) -> Image.Image:
    share = LONGEST_PX / max(image.size)
    if share >= 1:
        return image
    return image.resize((max(1, round(image.width * share)), max(1, round(image.height * share))),
                        Image.Resampling.BOX)


def _lens(poses: Poses, told: Told, size_px: Size, focal_px: float | None) -> Lens:
    """The lens of pictures of this size. Raises SaccadeError if nothing tells it."""
    if told.intrinsics_px is not None:
        return Lens(told.intrinsics_px, size_px)
    lens, notes = poses.lens(size_px)
    if lens is not None:
        told.notes += [each for note in notes if (each := _by_options(note)) not in told.notes]
        return lens
    if focal_px is None:
        raise SaccadeError("nothing tells the focal length of the pictures: give --intrinsics fx,fy,cx,cy, in pixels")
    return Lens((focal_px, focal_px, size_px[0] / 2, size_px[1] / 2), size_px)


def _smaller(lens: Lens, size_px: Size, rgb: NDArray[np.uint8]) -> Intrinsics:
    return scaled(lens.of(size_px), size_px, (rgb.shape[1], rgb.shape[0]))


class _Straighten:
    """Removes the distortion of a lens from pictures. Where the pixels are is kept, because it is mostly the same."""

    def __init__(self) -> None:
        self._known: tuple[tuple, NDArray] | None = None

    def __call__(self, picture: Picture, lens: Lens) -> Picture:
        if not lens.distorts:
            return picture
        places = self._places(picture, lens)
        rgb = np.stack([map_coordinates(picture.rgb[..., channel], places, order=1, mode="nearest")
                        for channel in range(3)], axis=-1)
        mask = None if picture.mask is None else straight_mask(picture.mask, places)
        return Picture(picture.name, rgb, picture.intrinsics_px, picture.world_from_camera, mask, places=places)

    def _places(self, picture: Picture, lens: Lens) -> NDArray[np.float32]:
        """The rows and columns [2, H, W] of the picture that a pinhole's pixels show."""
        key = (lens.distortion, lens.fisheye, picture.intrinsics_px, picture.rgb.shape)
        if self._known is None or self._known[0] != key:
            height, width = picture.rgb.shape[:2]
            fx, fy, cx, cy = picture.intrinsics_px
            x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
            rays = np.stack([x.ravel(), y.ravel()], axis=-1)
            shown = np.full(rays.shape, -1e6)
            near = np.linalg.norm(rays, axis=1) <= widest(dict(lens.distortion), fisheye=lens.fisheye)
            shown[near] = Lens(picture.intrinsics_px, (width, height), lens.distortion, lens.fisheye).pixels(rays[near])
            self._known = key, (shown[:, ::-1].T - 0.5).reshape(2, height, width).astype(np.float32)
        return self._known[1]


def straight_mask(mask: NDArray[np.bool_], places: NDArray[np.float32]) -> NDArray[np.bool_]:
    """A mask [H, W] without the distortion that was removed from its picture."""
    found = map_coordinates(mask.astype(np.float32), places, order=1, mode="constant", cval=0.0)
    return np.asarray(found > 0.5)
