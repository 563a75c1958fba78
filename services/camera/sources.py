"""Sources of real images: a folder, a video file or a webcam. Each image has an index and a time."""

from __future__ import annotations

import itertools
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.opencv import opencv
from saccade.services.camera.video import VideoFile
from saccade.shared.errors import NAME_LIMIT, SaccadeError, printable
from saccade.shared.world.images import Size, image_size, read_image

WEBCAM_DIGITS = 4
ROS_PREFIX = "ros:"  # of a topic that is heard live
MAX_IMAGES, MAX_ENTRIES = 100_000, 1_000_000  # of a folder
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DEFAULT_RATE_HZ = 10.0
RELEASE_S = 1.0  # how long to wait for a webcam's thread to end
SILENT_S = 5.0  # after this time without an image a webcam counts as failed


@dataclass(frozen=True)
class SourceImage:
    """An image: RGB [H, W, 3], number from 0, time in seconds since the source began, file name ("" if none)."""

    rgb: NDArray[np.uint8]
    index: int
    time_s: float
    name: str = ""

    def __str__(self) -> str:
        return f"{self.name or f'image {self.index}'} at {self.time_s:.3f} s"


class Source(Protocol):
    """Images in order, all of one size. Iterating again begins with the first image."""

    name: str
    size_px: Size
    period_s: float  # from one image to the next
    endless: bool

    def __iter__(self) -> Iterator[SourceImage]:
        """Yields the images. Raises SaccadeError if an image cannot be read."""


def open_source(text: str, *, rate_hz: float = DEFAULT_RATE_HZ) -> Source:
    """Opens a folder of PNG or JPEG images, a video file, or a webcam (`webcam:0`, `/dev/video0`).

    `rate_hz` is the number of images per second from a folder or a webcam; a video has its own rate. Raises
    SaccadeError if the source does not exist or cannot be read.
    """
    number = webcam_number(text)
    if number is not None:
        return Webcam(number, rate_hz)
    path = Path(text)
    if os.path.isdir(path):
        return Folder(path, rate_hz)
    need = "give a folder of images, a video file, a ROS 2 bag, or a webcam such as webcam:0"
    if not os.path.isfile(path):
        what = "is neither a folder nor a file" if os.path.exists(path) else "is not there"
        raise SaccadeError(f"camera source {text} {what}: {need}")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise SaccadeError(f"camera source {text} is a single image: give the folder that it is in")
    return Video(path, rate_hz)


def webcam_number(text: str) -> int | None:
    """The number of a webcam: 0 for `webcam:0` and for `/dev/video0`. None for any other text. Raises SaccadeError if
    no webcam can have the number."""
    match = re.fullmatch(r"(?:webcam:|/dev/video)([0-9]+)", text)
    if match and len(match[1]) > WEBCAM_DIGITS:
        raise SaccadeError(f"camera source {printable(text, NAME_LIMIT)}: give a number of at most {WEBCAM_DIGITS} "
                           "digits, such as webcam:0")
    return int(match[1]) if match else None


def is_live(text: str) -> bool:
    """Whether a source is a device or a topic of ROS, not a file. Raises SaccadeError like `webcam_number`."""
    return text.startswith(ROS_PREFIX) or webcam_number(text) is not None


def absolute(text: str) -> str:
    """The source as a text that means the same in every working directory."""
    return text if is_live(text) else str(Path(text).resolve())


class Folder:
    """The PNG and JPEG files of a folder, without hidden files, sorted by name (`2.png` comes before `10.png`).

    Raises SaccadeError if the folder or an image cannot be read, if it has no image, or if the sizes differ.
    """

    endless = False

    def __init__(self, path: Path, rate_hz: float = DEFAULT_RATE_HZ):
        self.name, self.period_s = str(path), 1.0 / rate_hz
        self.paths = image_paths(path)
        self.size_px = _common_size(self.paths)

    def __iter__(self) -> Iterator[SourceImage]:
        for index, path in enumerate(self.paths):
            yield SourceImage(read_image(path), index, index * self.period_s, path.name)


def image_paths(folder: Path) -> list[Path]:
    """The PNG and JPEG files of a folder, without hidden files, sorted by name. Raises SaccadeError if there are none
    or too many, or if the folder cannot be read."""
    paths = sorted(_images_in(folder), key=_natural)
    if not paths:
        raise SaccadeError(f"folder {folder} holds no image: put PNG or JPEG files into it")
    return paths


def _images_in(folder: Path) -> list[Path]:
    """The paths that look like images, in no order. Raises SaccadeError for a folder that has too many entries."""
    found: list[Path] = []
    try:
        with os.scandir(folder) as entries:
            for count, entry in enumerate(entries, start=1):
                if entry.name.lower().endswith(IMAGE_SUFFIXES) and not entry.name.startswith("."):
                    found.append(folder / entry.name)
                if len(found) > MAX_IMAGES or count > MAX_ENTRIES:
                    raise SaccadeError(f"folder {folder} holds more than {MAX_IMAGES} images or {MAX_ENTRIES} entries: "
                                       "give a part of them in a folder of its own")
    except OSError as error:
        raise SaccadeError(f"folder {folder} cannot be read: {error.strerror}") from error
    return found


def _natural(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)  # text and digits by turns
    return [int(part) if k % 2 else part.casefold() for k, part in enumerate(parts)], path.name


def _common_size(paths: list[Path]) -> Size:
    """The common size of all images. Raises SaccadeError if sizes differ: no intrinsics would hold for all images."""
    first, *others = paths
    size = image_size(first)
    for path in others:
        other = image_size(path)
        if other != size:
            raise SaccadeError(f"image {path} is {other[0]}x{other[1]} pixels, {first.name} is {size[0]}x{size[1]}: "
                               "the images of a folder must come from one camera, all in the same orientation")
    return size


class Video:
    """A video file. Each image has the time of its frame, or a time by the frame rate if the frame has none.

    Raises SaccadeError if PyAV is not installed, or if the file is damaged or of an unknown format.
    """

    endless = False

    def __init__(self, path: Path, rate_hz: float = DEFAULT_RATE_HZ):
        self.name, self._file = str(path), VideoFile(path, rate_hz)
        self.period_s, self.size_px = self._file.period_s, self._file.size_px

    def __iter__(self) -> Iterator[SourceImage]:
        for index, (rgb, time_s) in enumerate(self._file):
            yield SourceImage(rgb, index, time_s)


class Webcam:
    """A camera of this machine. It always gives its newest image, with the time since the first by `clock` (seconds).

    Raises SaccadeError if OpenCV is not installed, or if the camera does not open or gives no image.
    """

    endless = True

    def __init__(self, number: int, rate_hz: float = DEFAULT_RATE_HZ, clock: Callable[[], float] = time.monotonic):
        self.name, self.period_s = f"webcam:{number}", 1.0 / rate_hz
        self._number, self._clock = number, clock
        capture = self._open()
        read, bgr = capture.read()
        capture.release()
        if not read:
            raise self._silent()
        self.size_px = _size(bgr)

    def _open(self) -> Any:
        capture = _capture(self._number)
        if not capture.isOpened():
            raise SaccadeError(f"{self.name} does not open: is it connected, permitted, and used by no other program?")
        return capture

    def _silent(self) -> SaccadeError:
        return SaccadeError(f"{self.name} gives no image: is it connected, and used by no other program?")

    def __iter__(self) -> Iterator[SourceImage]:
        newest: queue.Queue = queue.Queue(maxsize=1)
        stop = threading.Event()
        thread = threading.Thread(target=_keep_newest, args=(self._open(), self._clock, newest, stop), daemon=True)
        thread.start()
        try:
            start = None
            for index in itertools.count():
                item = None
                with suppress(queue.Empty):
                    item = newest.get(timeout=SILENT_S)
                if item is None:
                    raise self._silent()
                at, bgr = item
                start = at if start is None else start
                yield SourceImage(_rgb(bgr), index, at - start)
        finally:
            stop.set()
            thread.join(RELEASE_S)


def _keep_newest(capture: Any, clock: Callable[[], float], newest: queue.Queue, stop: threading.Event) -> None:
    """Reads the camera's images as they come and keeps only the newest in the queue. None means that no more come.

    Drivers queue images, so a slow reader would otherwise get old ones.
    """

    def put(item: tuple[float, NDArray[np.uint8]] | None) -> None:
        with suppress(queue.Empty):
            newest.get_nowait()
        newest.put(item)

    try:
        while not stop.is_set():
            read, bgr = capture.read()
            if not read:
                break
            put((clock(), bgr))
    finally:
        put(None)
        capture.release()


def _cv2() -> Any:
    """OpenCV, imported when the first webcam is opened. Raises SaccadeError if it is not installed."""
    return opencv("webcams need", ", or give a folder of images")


def _capture(number: int) -> Any:
    cv2 = _cv2()
    try:
        return cv2.VideoCapture(number, cv2.CAP_ANY)
    except cv2.error as error:
        raise SaccadeError(f"webcam:{number} cannot be opened ({error}): give another one") from error


def _rgb(bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(bgr[..., ::-1])


def _size(bgr: NDArray[np.uint8]) -> Size:
    return bgr.shape[1], bgr.shape[0]
