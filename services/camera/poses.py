"""The camera's pose at each image, read from a file of JSON lines or in the TUM trajectory format.

Poses are in the agent's world: metres, z up, table top at z = 0.
JSON lines: `{"image": "a.png", "world_from_camera": 4x4}`, with "index" (from 0) or "time_s" in place of "image". A
camera that stands still has one line without any of the three.
TUM: `timestamp tx ty tz qx qy qz qw`, the pose of the camera in the world.
Blank lines, and lines that begin with #, are ignored.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from saccade.services.camera.sources import SourceImage
from saccade.shared.errors import SaccadeError, printable, told
from saccade.shared.files import MIB, parse_json, read_text
from saccade.shared.world.geometry import Array, pose

Convention = Literal["opengl", "opencv"]  # the camera looks along -z with +y up, or along +z with +y down
Key = tuple[str, str | int | float | None]  # how a pose is assigned (image, index, time_s or still), and the value

MAX_FILE_BYTES, MAX_POSES, MAX_LINE = 64 * MIB, 500_000, 4096
MAX_M = 1e5  # from the origin: nothing is seen from further away
_NEED = "give JSON lines or the TUM format"
MAX_GAP_S = 1.0  # poses are not interpolated across a longer gap, because the camera's path there is unknown
HOLD_S = 0.1  # a pose also holds for images this long before and after it
ORTHONORMAL = 1e-3  # largest error of R^T R that is accepted: poses are written with four digits or more
UNIT_QUATERNION = 1e-2  # largest error of a quaternion's length that is accepted
STILL: Key = ("still", None)
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Poses:
    """Poses world_from_camera [4, 4] (OpenGL) by the file name, the index or the time of an image.

    A camera that stands still has one pose for all images (STILL).
    """

    table: dict[Key, Array]
    name: str = ""

    @classmethod
    def still(cls, world_from_camera: Array) -> Poses:
        """The poses of a camera that stands still at this pose [4, 4]."""
        return cls({STILL: world_from_camera})

    def of(self, image: SourceImage) -> Array | None:
        """The camera's pose [4, 4] at an image. None if it is not known."""
        for key in (STILL, ("image", image.name), ("index", image.index)):
            if key in self.table:
                return self.table[key]
        return self._at(image.time_s)

    def end_before(self, image: SourceImage) -> bool:
        """Whether neither this image nor a later one can have a pose: all poses are by time, and all are past."""
        times = self._times_s
        return 0 < len(times) == len(self.table) and image.time_s > times[-1] + HOLD_S

    @cached_property
    def _times_s(self) -> Array:
        return np.array(self._keys("time_s"), dtype=np.float64)

    def _keys(self, kind: str) -> list:
        return sorted(value for what, value in self.table if what == kind)

    def _at(self, time_s: float) -> Array | None:
        """The pose [4, 4] at a time. None if there is none near enough.

        Between two poses the position is interpolated on the line and the rotation on the shortest arc.
        """
        times = self._times_s
        if len(times) == 0:
            return None
        after = int(np.searchsorted(times, time_s))
        if 0 < after < len(times) and times[after] - times[after - 1] <= MAX_GAP_S:
            ends = times[after - 1:after + 1]
            first, last = (self.table["time_s", t] for t in ends)
            share = (time_s - ends[0]) / (ends[1] - ends[0])
            turn = Slerp(ends, Rotation.from_matrix([first[:3, :3], last[:3, :3]]))(time_s)
            return pose(turn.as_matrix(), (1 - share) * first[:3, 3] + share * last[:3, 3])
        nearest = times[np.abs(times - time_s).argmin()]
        return self.table["time_s", nearest] if abs(nearest - time_s) <= HOLD_S else None

    def __str__(self) -> str:
        parts = [f"{len(keys)} by {kind}, {printable(str(keys[0]), 100)} to {printable(str(keys[-1]), 100)}"
                 for kind in ("image", "index", "time_s") if (keys := self._keys(kind))]
        return f"{self.name} ({'; '.join(parts)})"


def read_poses(path: Path, convention: Convention | None = None) -> Poses:
    """Reads the poses of a file and converts them from `convention` to OpenGL.

    Without a convention, JSON lines are OpenGL and TUM trajectories are OpenCV. Raises SaccadeError if the file cannot
    be read. Raises SaccadeError with file:line if a line is damaged, has no valid rotation, or repeats another line.
    """
    lines = _lines(path)
    is_json = lines[0][1].startswith("{")
    opencv = (convention or ("opengl" if is_json else "opencv")) == "opencv"
    table: dict[Key, Array] = {}
    for number, line in lines:
        try:
            key, world_from_camera = _json_line(line) if is_json else _tum_line(line)
            if key in table:
                raise ValueError(f"a second pose for {key[0]} {printable(str(key[1]), 100)}")
            if table and STILL in (key, *table):
                raise ValueError("a pose without image, index or time_s holds for all images: give no other pose")
        except (ValueError, OverflowError) as error:
            raise SaccadeError(f"poses {path}:{number}: {error}") from error
        table[key] = world_from_camera @ _OPENCV_FROM_OPENGL if opencv else world_from_camera
    return Poses(table, str(path))


def _lines(path: Path) -> list[tuple[int, str]]:
    """The lines that are neither blank nor comments, with their numbers. Raises SaccadeError if there are none."""
    text = io.StringIO(read_text(path, "poses", _NEED, MAX_FILE_BYTES))
    numbered = enumerate(map(str.strip, text), start=1)
    lines = list(islice(((n, line) for n, line in numbered if line and not line.startswith("#")), MAX_POSES + 1))
    if not lines:
        raise SaccadeError(f"poses {path} holds no pose: {_NEED}")
    if len(lines) > MAX_POSES:
        raise SaccadeError(f"poses {path} holds more than {MAX_POSES} poses: leave out what no image needs")
    if too_long := next((n for n, line in lines if len(line) > MAX_LINE), None):
        raise SaccadeError(f"poses {path}:{too_long}: a line of more than {MAX_LINE} characters: {_NEED}")
    return lines


def _json_line(line: str) -> tuple[Key, Array]:
    try:
        tree: Any = parse_json(line)
    except ValueError as error:
        raise ValueError(f"not JSON ({error})") from error
    if not isinstance(tree, dict) or "world_from_camera" not in tree or len(tree) > 2:
        raise ValueError('give {"world_from_camera": 4x4} and one of image, index and time_s')
    kind, value = next(((k, v) for k, v in tree.items() if k != "world_from_camera"), STILL)
    kinds: dict[str, Any] = {"image": str, "index": int, "time_s": (int, float), "still": type(None)}
    if kind not in kinds:
        raise ValueError(f"unknown key {told(kind)}: give one of image, index and time_s")
    if not isinstance(value, kinds[kind]) or isinstance(value, bool):
        raise ValueError(f"{kind}: {told(value)} is not a {'text' if kind == 'image' else 'number'}")
    if kind == "time_s" and not math.isfinite(value):
        raise ValueError(f"time_s: {value} is not finite")
    if kind == "index" and not 0 <= value < 2 ** 63:
        raise ValueError("index: no image has such a number")
    return (kind, value), rigid(tree["world_from_camera"])


def _tum_line(line: str) -> tuple[Key, Array]:
    try:
        time_s, *rest = (float(word) for word in line.split())
    except ValueError:
        rest = []
    if len(rest) != 7:
        raise ValueError("neither a JSON object nor the eight numbers of TUM: timestamp tx ty tz qx qy qz qw")
    if not np.isfinite([time_s, *rest]).all():
        raise ValueError("not finite")
    if max(map(abs, rest)) > MAX_M:
        raise ValueError(f"a number beyond {MAX_M:g}")
    length = float(np.linalg.norm(rest[3:]))
    if abs(length - 1.0) > UNIT_QUATERNION:
        raise ValueError(f"the quaternion has length {length:.3f}, not 1")
    return ("time_s", time_s), pose(Rotation.from_quat(rest[3:]).as_matrix(), rest[:3])


def rigid(matrix: ArrayLike) -> Array:
    """A rigid transform [4, 4] whose rotation is made orthonormal. Raises ValueError if the matrix is not rigid."""
    try:
        transform = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        transform = np.empty(0)
    if transform.shape != (4, 4):
        raise ValueError("world_from_camera is not 4x4 numbers")
    if not np.isfinite(transform).all():
        raise ValueError("world_from_camera is not finite")
    if np.abs(transform).max() > MAX_M:
        raise ValueError(f"world_from_camera has a number beyond {MAX_M:g}")
    if not np.allclose(transform[3], (0, 0, 0, 1), atol=1e-9):
        raise ValueError("world_from_camera does not end in the row 0 0 0 1: is it transposed?")
    rotation = transform[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > ORTHONORMAL:
        raise ValueError(f"the rotation is not orthonormal (R^T R is off by {error:.2g})")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the rotation mirrors (determinant -1)")
    u, _, vt = np.linalg.svd(rotation)
    return pose(u @ vt, transform[:3, 3])
