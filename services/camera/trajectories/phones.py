"""What apps on phones with ARKit write: Record3D (`.r3d`) and folders of Stray Scanner. The world's y axis is up."""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from saccade.services.camera.trajectories.lens import Lens, lens
from saccade.services.camera.trajectories.rigid import from_quaternion, number
from saccade.services.camera.trajectories.tables import data_of, header_of, order_of
from saccade.services.camera.trajectories.text import (
    MAX_FILE_BYTES,
    MAX_POSES,
    later,
    numbers_of,
    text_of,
    within,
    words_of,
)
from saccade.services.camera.trajectories.trajectory import Asked, Key, Stored
from saccade.services.camera.trajectories.transforms_json import json_of
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import MIB, opened, size_of

MAX_ARCHIVE_BYTES = 64 * 1024 * MIB  # of which only the list of files and `metadata` are read
MAX_LIST_BYTES = 16 * MIB  # of the files in an archive, some 200 000
METADATA = "metadata"
_RECORD3D = "give the .r3d file as Record3D exports it"
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")  # of Stray Scanner
_STRAY = "give the folder as Stray Scanner exports it"


class _Limited:
    """A stream of which not more than `limit` bytes are read at once: a list of files may claim any size."""

    def __init__(self, stream: BinaryIO, limit: int):
        self._stream, self._limit = stream, limit
        self.seek, self.tell, self.seekable = stream.seek, stream.tell, stream.seekable

    def read(self, size: int = -1) -> bytes:
        """Reads up to `size` bytes. Raises BadZipFile if that is more than the limit."""
        data = self._stream.read(self._limit + 1 if size < 0 else min(size, self._limit + 1))
        if len(data) > self._limit:
            raise zipfile.BadZipFile(f"a part is larger than {size_of(self._limit)}")
        return data


def metadata_of(path: Path) -> str:
    """The text of `metadata` in a .r3d file. Raises SaccadeError if the archive is damaged, lacks it, or if it is too
    large."""
    with opened(path, "poses", _RECORD3D, MAX_ARCHIVE_BYTES) as stream:
        try:
            return _metadata(path, stream)
        except UnicodeDecodeError as error:
            raise SaccadeError(f"poses {path}: {METADATA} is not a text in UTF-8 (byte {error.start}): "
                               f"{_RECORD3D}") from error
        except (zipfile.BadZipFile, zlib.error, struct.error, NotImplementedError, RuntimeError, EOFError, ValueError,
                OverflowError) as error:
            raise SaccadeError(f"poses {path} is a damaged archive ({error}): {_RECORD3D}") from error


def _metadata(path: Path, stream: BinaryIO) -> str:
    with zipfile.ZipFile(_Limited(stream, MAX_LIST_BYTES)) as archive:
        found = next((entry for entry in archive.infolist() if entry.filename == METADATA), None)
        if found is None:
            raise SaccadeError(f"poses {path} is an archive without {METADATA}: {_RECORD3D}")
        if found.file_size > MAX_FILE_BYTES:
            raise SaccadeError(f"poses {path}: {METADATA} is larger than {size_of(MAX_FILE_BYTES)}: {_RECORD3D}")
        if found.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or found.flag_bits & 1:
            raise SaccadeError(f"poses {path}: {METADATA} is encrypted or packed in an unusual way: {_RECORD3D}")
        with archive.open(found) as file:
            data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise SaccadeError(f"poses {path}: {METADATA} is larger than {size_of(MAX_FILE_BYTES)}: {_RECORD3D}")
    return data.decode().removeprefix("\ufeff")


def read_record3d(path: Path, text: str, asked: Asked) -> Stored:
    """Reads the `metadata` of Record3D: a list of quaternion x y z w and position for the frames from 0, and K. Raises
    SaccadeError, which names the frame, if something in it is wrong."""
    tree = json_of(path, text, "the metadata of Record3D")
    rows = tree.get("poses")
    if not isinstance(rows, list) or not 0 < len(rows) <= MAX_POSES:
        raise SaccadeError(f"poses {path} hold no pose, or more than {MAX_POSES}: {_RECORD3D}")
    order = asked.quaternion or "xyzw"
    transforms = []
    for k, row in enumerate(rows):
        with within(path, f", frame {k}"):
            if not isinstance(row, list) or len(row) != 7:
                raise ValueError("not seven numbers, quaternion x y z w and position: export it again, whole")
            numbers = [number(value, "poses") for value in row]
            transforms.append(from_quaternion(numbers[4:], numbers[:4], order))
    with within(path, ""):
        lenses = _lenses(tree, len(rows))
        times_s = _times(tree, len(rows))
    keys = tuple(("index", k) for k in range(len(rows)))
    return Stored("record3d", keys, np.stack(transforms), axes="opengl", up="y", quaternion=order, times_s=times_s,
                  lenses=lenses)


def _lenses(tree: dict[str, Any], count: int) -> tuple[Lens, ...]:
    """The lens of all frames (K, column by column), or of each (fx, fy, cx, cy)."""
    size = (number(tree["w"], "w"), number(tree["h"], "h")) if "w" in tree and "h" in tree else None
    each = tree.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and len(each) == count:
        return tuple(_lens(row, size) for row in each)
    k = tree.get("K")
    if k is None:
        return ()
    if not isinstance(k, list) or len(k) != 9:
        raise ValueError(f"K: {told(k)} is not a list of nine numbers: export it again")
    return (_lens(k, size),)


def _lens(row: Any, size: tuple[float, float] | None) -> Lens:
    if isinstance(row, list) and len(row) == 9:  # a matrix, column by column
        row = [row[0], row[4], row[6], row[7]]
    if not isinstance(row, list) or len(row) != 4:
        raise ValueError(f"intrinsics: {told(row)} are neither four numbers nor nine: export it again")
    return lens({name: number(value, name) for name, value in zip(("fx", "fy", "cx", "cy"), row, strict=False)}, size)


def _times(tree: dict[str, Any], count: int) -> np.ndarray | None:
    """The times [N] of the frames in seconds. None if the file has none. Raises ValueError if they go back."""
    stamps, rate_hz = tree.get("frameTimestamps"), tree.get("fps")
    if isinstance(stamps, list) and len(stamps) == count:
        times: list[float] = []
        for k, stamp in enumerate(stamps):
            try:
                times.append(later(times[-1] if times else None, number(stamp, "frameTimestamps")))
            except ValueError as error:
                raise ValueError(f"frame {k}: {error}") from error
        return np.array(times)
    return None if rate_hz is None else np.arange(count) / number(rate_hz, "fps", 0, 1000)


def read_stray(path: Path, asked: Asked) -> Stored:
    """Reads the odometry.csv and the camera_matrix.csv of a folder: positions and quaternions x y z w, in OpenCV camera
    axes. Newer folders have the intrinsics of each frame. Raises SaccadeError with file:line if a line is damaged or if
    the time goes back."""
    text = text_of(path)
    header = header_of(text) or [*_COLUMNS]
    order = asked.quaternion or order_of(header, "xyzw")
    keys: list[Key] = []
    times: list[float] = []
    transforms, lenses = [], []
    for number_of_line, line in data_of(path, text):
        with within(path, f":{number_of_line}"):
            time_s, frame, rest = _stray_line(line, header, len(keys))
            times.append(later(times[-1] if times else None, time_s))
            if keys and frame <= int(keys[-1][1] or 0):
                raise ValueError(f"frame {frame} comes after frame {keys[-1][1]}: sort the lines, and give each once")
            keys.append(("index", frame))
            transforms.append(from_quaternion(rest[:3], rest[3:7], order))
            lenses.append(_stray_lens(line, header))
    of_frames = tuple(x for x in lenses if x is not None)
    if len(of_frames) < len(lenses):
        of_frames = _camera_matrix(path.with_name("camera_matrix.csv"))
    return Stored("stray", tuple(keys), np.stack(transforms), up="y", quaternion=order, lenses=of_frames,
                  times_s=None if header[0] == "x" else np.array(times))


def _stray_line(line: str, header: Sequence[str], count: int) -> tuple[float, int, list[float]]:
    """The time, the number of the frame, and position and quaternion [7]. An older folder has neither of the first
    two."""
    needed = len(_COLUMNS) - 2 if header[0] == "x" else len(_COLUMNS)
    try:
        numbers = [float(word) for word in words_of(line)[:needed]]
    except ValueError:
        numbers = []
    if len(numbers) < needed:
        raise ValueError(f"not {needed} numbers: {', '.join(_COLUMNS[-needed:])}")
    if needed < len(_COLUMNS):
        return float(count), count, numbers
    if not np.isfinite(numbers[:2]).all() or not 0 <= numbers[1] < 2 ** 53:
        raise ValueError("the time or the number of the frame is none: leave out the line")
    return numbers[0], int(numbers[1]), numbers[2:]


def _stray_lens(line: str, header: Sequence[str]) -> Lens | None:
    """The lens of a frame. None if its columns are missing or empty."""
    told = {name: word for name, word in zip(header, words_of(line), strict=False) if name in ("fx", "fy", "cx", "cy")}
    if len(told) < 4 or not all(told.values()):
        return None
    try:
        return lens({name: float(word) for name, word in told.items()})
    except ValueError as error:
        raise ValueError(f"fx, fy, cx, cy: {error}") from error


def _camera_matrix(path: Path) -> tuple[Lens, ...]:
    """The lens of a 3x3 matrix. None if there is no such file."""
    if not os.path.exists(path):
        return ()
    lines = data_of(path, text_of(path))
    with within(path, f":{lines[0][0]}"):
        try:
            rows = [numbers_of(line) for _, line in lines]
        except ValueError:
            rows = []
        if [len(row) for row in rows] != [3, 3, 3]:
            raise ValueError(f"not a matrix of 3x3 numbers: {_STRAY}")
        return (lens({"fx": rows[0][0], "fy": rows[1][1], "cx": rows[0][2], "cy": rows[1][2]}),)
