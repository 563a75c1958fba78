"""What a file of poses says, in the axes and units of the agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.trajectories.rigid import MAX_M, inverse
from saccade.shared.config import PosesFormat
from saccade.shared.errors import SaccadeError, printable
from saccade.shared.world.geometry import Array, pose

Key = tuple[str, str | int | float | None]  # how a pose is assigned (image, index, time_s or still), and the value
Axes = Literal["opengl", "opencv"]  # the camera looks along -z with +y up, or along +z with +y down
Direction = Literal["world_from_camera", "camera_from_world"]
Order = Literal["xyzw", "wxyz"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]

STILL: Key = ("still", None)
EPOCH_S = 1e8  # a first time beyond it (March 1973) is counted since 1970, not since the camera began
NAMES: dict[str, str] = {
    "json-lines": "JSON lines", "tum": "a TUM trajectory", "kitti": "KITTI", "euroc": "EuRoC CSV",
    "transforms": "transforms.json of nerfstudio or instant-ngp", "colmap": "COLMAP", "record3d": "Record3D",
    "stray": "Stray Scanner"}
ORIGIN_NOTE = "the origin is the file's; the agent expects it on the table, whose top is at z = 0"
_AXES_NAMES = {"opengl": "OpenGL camera axes", "opencv": "OpenCV camera axes"}
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between the two camera axes, in both directions
_WORLD_FROM_FILE = {  # rotations [3, 3] that turn the axis which points up onto z
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]], "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]]}


@dataclass(frozen=True)
class Asked:
    """What the user says about a file (`camera.poses_...`). Where it is None, the format decides.

    `scale` is the length of the file's unit in metres. `original` undoes the `applied_transform` of a transforms.json.
    """

    format: PosesFormat | None = None
    axes: Axes | None = None
    direction: Direction | None = None
    quaternion: Order | None = None
    up: Up | None = None
    scale: float = 1.0
    original: bool = False


@dataclass(frozen=True)
class Stored:
    """The poses as a file holds them: `transforms` [N, 4, 4] in the file's axes, direction and unit.

    `axes`, `direction` and `up` are those of the format; `up` is None if the format does not fix it. `quaternion` is
    the order that was read, None if the format has no quaternions. `lenses` holds none, one, or one for each pose.
    """

    format: PosesFormat
    keys: tuple[Key, ...]
    transforms: Array
    axes: Axes = "opencv"
    direction: Direction = "world_from_camera"
    up: Up | None = "z"
    quaternion: Order | None = None
    times_s: Array | None = None
    lenses: tuple[Lens, ...] = ()
    notes: tuple[str, ...] = ()
    applied: Array | None = None
    metric: bool = True  # whether the format's unit is the metre


@dataclass(frozen=True)
class Trajectory:
    """The poses of a camera: `world_from_camera` [N, 4, 4] in metres, z up, in OpenGL camera axes.

    `keys` says for each pose which image it belongs to: by name, by number from 0, or by time in seconds. `times_s` [N]
    are the times if the file has them, less `epoch_s`. `told` says in one line which format and conventions were
    taken, `notes` what else the user must know. `usual` is whether the file is Saccade's own and nothing else was
    asked, so that there is nothing to tell.
    """

    path: Path
    format: PosesFormat
    keys: tuple[Key, ...]
    world_from_camera: Array
    told: str
    times_s: Array | None = None
    lenses: tuple[Lens, ...] = ()
    notes: tuple[str, ...] = ()
    epoch_s: float = 0.0
    usual: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the images, if the poses are assigned by name."""
        return tuple(str(value) for kind, value in self.keys if kind == "image")

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the images from 0, if the poses are assigned by number."""
        return tuple(value for kind, value in self.keys if kind == "index" and isinstance(value, int))


def in_the_agents_world(stored: Stored, asked: Asked, path: Path) -> Trajectory:
    """Converts poses into the axes and units of the agent. Raises SaccadeError if what the user asks does not fit the
    format, or if the scale puts a camera too far away."""
    if asked.quaternion and stored.quaternion is None:
        raise SaccadeError(f"camera.poses_quaternion: {NAMES[stored.format]} has no quaternions: leave it out")
    if asked.original and stored.applied is None:
        raise SaccadeError(f"camera.poses_original: poses {path} have no applied_transform: leave it out")
    axes, up = asked.axes or stored.axes, asked.up or stored.up
    direction = asked.direction or stored.direction
    poses = stored.transforms if direction == "world_from_camera" else inverse(stored.transforms)
    poses = poses @ _FLIP if axes == "opencv" else poses
    if asked.original and stored.applied is not None:
        poses = inverse(stored.applied[None]) @ poses
    turn = np.array(_WORLD_FROM_FILE[up or "z"], dtype=np.float64)
    positions = (poses[:, :3, 3] @ turn.T) * asked.scale
    if np.abs(positions).max() > MAX_M:
        raise SaccadeError(f"camera.poses_scale {asked.scale:g}: a camera of {path} would stand beyond {MAX_M:g} m: "
                           "give the length of the file's unit in metres")
    keys, times_s, epoch_s = _since_the_first(stored)
    notes = (*stored.notes, *_notes(stored, asked, up, epoch_s))
    return Trajectory(path, stored.format, keys, pose(turn @ poses[:, :3, :3], positions),
                      _told(stored, asked, path, axes, direction, up), times_s, stored.lenses, notes, epoch_s,
                      usual=stored.format == "json-lines" and asked == Asked(asked.format, asked.axes))


def _since_the_first(stored: Stored) -> tuple[tuple[Key, ...], Array | None, float]:
    """Keys and times [N] in seconds, less the time of the first pose if they are counted since 1970."""
    times_s = stored.times_s
    if times_s is None or len(times_s) == 0 or times_s.min() < EPOCH_S:
        return stored.keys, times_s, 0.0
    epoch_s = float(times_s.min())
    keys = tuple((kind, value - epoch_s) if kind == "time_s" and isinstance(value, int | float) else (kind, value)
                 for kind, value in stored.keys)
    return keys, times_s - epoch_s, epoch_s


def _told(stored: Stored, asked: Asked, path: Path, axes: str, direction: str, up: str | None) -> str:
    by = " and ".join(dict.fromkeys(f"by {kind}" for kind, _ in stored.keys if kind != "still")) or "for all images"
    count = len(stored.keys)
    turned = [_AXES_NAMES[axes], direction]
    if stored.quaternion:
        turned.append(f"quaternions {' '.join(stored.quaternion)}")
    turned.append(f"the world's {up} axis points up" if up else "the world's axes as they are")
    turned.append(f"one unit is {asked.scale:g} m")
    return (f"poses {printable(path.name, 100)} are read as {NAMES[stored.format]}: {count} "
            f"{'pose' if count == 1 else 'poses'} {by}; {', '.join(turned)}")


def _notes(stored: Stored, asked: Asked, up: str | None, epoch_s: float) -> list[str]:
    notes = []
    if epoch_s:
        notes.append(f"times are counted since 1970: the first pose, at {epoch_s:.3f} s, is taken as the time of the "
                     "first image, unless the images' names are such times")
    if up is None:
        notes.append(f"{NAMES[stored.format]} does not say which way is up, and the world's axes are kept: give "
                     "camera.poses_up if z does not point up")
    if not stored.metric and asked.scale == 1.0:
        notes.append(f"the unit of {NAMES[stored.format]} is not known, and metres are taken: give camera.poses_scale")
    if stored.applied is not None:
        done = "is undone" if asked.original else "is kept as part of the poses; camera.poses_original undoes it"
        notes.append(f"applied_transform {done}")
    if stored.format not in ("json-lines", "tum"):
        notes.append(ORIGIN_NOTE)
    return notes
