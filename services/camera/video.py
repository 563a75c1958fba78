"""Video files, read with PyAV: rotated, interlaced, grey, of variable frame rate, in any container that it knows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.world.images import MAX_PIXELS, Size

MAX_RATE_HZ = 1000.0  # a higher frame rate in a video's header is not believed
WHOLE = 0.9  # share of the announced frames, or of the announced time, that a video must have
MOST_DAMAGED = 100  # packets that cannot be decoded, after which the video counts as broken off

Image = NDArray[np.uint8]


class VideoFile:
    """A video file: its size (width, height), the seconds from one frame to the next, and its frames, upright as the
    file says.

    Raises SaccadeError if PyAV is not installed, or if the file is damaged, too large or of an unknown format.
    """

    def __init__(self, path: Path, rate_hz: float):
        self._path = path
        with self._open() as (container, stream):
            rate = float(stream.average_rate or 0.0)
            first = next(_frames(container, stream), None)
        if first is None:
            raise self._unreadable("it has no frame")
        rgb = _rgb(first)
        self.period_s = 1.0 / (rate if 0 < rate <= MAX_RATE_HZ else rate_hz)
        self.size_px: Size = (rgb.shape[1], rgb.shape[0])

    def __iter__(self) -> Iterator[tuple[Image, float]]:
        """Yields RGB images [H, W, 3] and their times in seconds since the stream began. A frame without a time, or
        with one that is not after the last, has a time by the frame rate. Raises SaccadeError after the last one if the
        video breaks off."""
        time_s, end_s = -self.period_s, 0.0
        count = 0
        with self._open() as (container, stream):
            begins_s = float((stream.start_time or 0) * stream.time_base)
            for frame in _frames(container, stream):
                count += 1
                end_s = end_s if frame.time is None else float(frame.time)
                stamp_s = -np.inf if frame.time is None else end_s - begins_s
                time_s = stamp_s if stamp_s > time_s else time_s + self.period_s
                yield _rgb(frame), float(time_s)
            announced, length_s = stream.frames, float(container.duration or 0) / 1e6
        if announced and count < WHOLE * announced:
            raise SaccadeError(f"video {self._path} breaks off after {count} of {announced} frames: cut off what is "
                               "damaged")
        if not announced and end_s + self.period_s < WHOLE * length_s:  # not every format tells the number of frames
            raise SaccadeError(f"video {self._path} breaks off after {end_s:.1f} of {length_s:.1f} s: cut off what is "
                               "damaged")

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, Any]]:
        av = pyav()
        try:
            with av.open(str(self._path)) as container:
                if not container.streams.video:
                    raise self._unreadable("it has no video")
                stream = container.streams.video[0]
                size = stream.codec_context.width, stream.codec_context.height
                if size[0] * size[1] > MAX_PIXELS:  # told by the header, before one is decoded
                    raise SaccadeError(f"video {self._path} has {size[0]}x{size[1]} pixels, more than {MAX_PIXELS}: "
                                       "give a smaller one")
                stream.codec_context.thread_count = 1  # every service uses one thread
                yield container, stream
        except (av.FFmpegError, OSError, ValueError) as error:
            raise self._unreadable(getattr(error, "strerror", None) or str(error)) from error

    def _unreadable(self, why: str) -> SaccadeError:
        return SaccadeError(f"video {self._path} cannot be read ({why}): it is damaged, empty, or of a format unknown "
                            "to FFmpeg; give another, or a folder of its images")


def pyav() -> Any:
    """The module av, without words of its own. Raises SaccadeError if it is not installed."""
    try:
        import av
    except ImportError as error:
        raise SaccadeError(f"videos need PyAV ({error}): pip install 'saccade[camera]', or give a folder of "
                           "images") from error
    av.logging.set_level(None)
    return av


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """The frames of a stream. Packets that cannot be decoded are left out; after many of them nothing more comes."""
    av, damaged = pyav(), 0
    packets = container.demux(stream)
    while damaged < MOST_DAMAGED:
        try:
            packet = next(packets, None)
            if packet is None:
                return
            yield from packet.decode()
        except av.FFmpegError:
            damaged += 1


def _rgb(frame: Any) -> Image:
    """A frame as RGB [H, W, 3], turned upright."""
    rgb = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(rgb, round(frame.rotation / 90)) if frame.rotation else rgb)
