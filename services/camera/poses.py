"""The camera's pose at each image, from a file in one of many formats (see `trajectories/`).

Poses are in the agent's world: metres, z up, table top at z = 0.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories.lens import Lens, one_lens
from saccade.services.camera.trajectories.reading import read_trajectory
from saccade.services.camera.trajectories.text import MAX_POSES
from saccade.services.camera.trajectories.trajectory import EPOCH_S, STILL, Asked, Axes, Key
from saccade.shared.config import CameraConfig
from saccade.shared.errors import printable
from saccade.shared.world.geometry import Array, pose
from saccade.shared.world.images import Size

__all__ = ["MAX_POSES", "Poses", "asked_of", "read_poses"]

MAX_GAP_S = 1.0  # poses are not interpolated across a longer gap, because the camera's path there is unknown
HOLD_S = 0.1  # a pose also holds for images this long before and after it
UNITS_S = (1e-9, 1e-6, 1e-3, 1.0)  # of a time since 1970 in an image's name


@dataclass(frozen=True)
class Poses:
    """Poses world_from_camera [4, 4] (OpenGL) by the file name, the index or the time of an image.

    A camera that stands still has one pose for all images (STILL). Times are counted from `epoch_s`. `lenses` are those
    that the file tells of: none, one, or one for each pose. `notes` tells the user what was taken, one line each.
    With `in_order`, images without names get the poses in the order of their names. `lens_from` names where the lenses
    are from.
    """

    table: dict[Key, Array]
    name: str = ""
    epoch_s: float = 0.0
    lenses: tuple[Lens, ...] = ()
    notes: tuple[str, ...] = ()
    in_order: bool = False
    lens_from: str = "the poses' file"

    @classmethod
    def still(cls, world_from_camera: Array) -> Poses:
        """The poses of a camera that stands still at this pose [4, 4]."""
        return cls({STILL: world_from_camera})

    def of(self, image: SourceImage) -> Array | None:
        """The camera's pose [4, 4] at an image. None if it is not known."""
        for key in (STILL, ("image", image.name), ("image", Path(image.name).stem), ("index", image.index)):
            if key in self.table:
                return self.table[key]
        if self.in_order and not image.name and image.index < len(self._in_order):  # an image of a video
            return self.table[self._in_order[image.index]]
        return self._at(self._time_s(image))

    def end_before(self, image: SourceImage) -> bool:
        """Whether neither this image nor a later one can have a pose: all poses are by time, and all are past."""
        times = self._times_s
        return 0 < len(times) == len(self.table) and image.time_s > times[-1] + HOLD_S

    def matched(self, names: Sequence[str]) -> Poses:
        """The poses for images with these names, in order, if they come from a format that names other images.

        If only the endings differ (`a.png` and `a.jpg`), they do not count. If no image has the name of a pose, and
        there are as many images as poses, the poses are taken in the order of their names.
        """
        if not self.in_order or not names or any(("image", name) in self.table for name in names):
            return self
        stems = {Path(str(name)).stem: self.table[kind, name] for kind, name in self._in_order}
        if len(stems) == len(self.table) and not stems.keys().isdisjoint(Path(name).stem for name in names):
            return replace(self, table={("image", stem): matrix for stem, matrix in stems.items()})
        if not len(names) == len(self._in_order) == len(self.table):
            return self
        note = f"no image has the name of a pose: the {len(names)} poses are taken in the order of their names"
        return replace(self, table={("index", k): self.table[key] for k, key in enumerate(self._in_order)},
                       notes=(*self.notes, note))

    def lens(self, size_px: Size) -> tuple[Lens | None, tuple[str, ...]]:
        """The lens that the file or a CameraInfo tells of, for images of this size (width, height), and notes. None if
        it tells none. Raises SaccadeError if it is that of other images or of several cameras."""
        lens, note = one_lens(self.lenses)
        if lens is None:
            return None, ()
        taken = lens.at(size_px, self.lens_from)
        told = f"intrinsics ({', '.join(f'{x:.2f}' for x in taken.of(size_px))}) px are those of {self.lens_from}"
        if lens.intrinsics_px is not None and lens.size_px is None:
            told += f", which does not tell their size: {size_px[0]}x{size_px[1]} pixels are taken"
        return taken, (told, *((note,) if note else ()))

    @property
    def advice(self) -> str:
        """What to do if no image has a pose."""
        return "give poses by the images' names, indices or times"

    @cached_property
    def _times_s(self) -> Array:
        return np.array(self._keys("time_s"), dtype=np.float64)

    @cached_property
    def _in_order(self) -> list[Key]:
        """The keys of the poses that are assigned by name; `2.png` comes before `10.png`."""
        return sorted((key for key in self.table if key[0] == "image"), key=lambda key: _natural(str(key[1])))

    def _keys(self, kind: str) -> list:
        return sorted(value for what, value in self.table if what == kind)

    def _time_s(self, image: SourceImage) -> float:
        """The image's time in seconds: by its name, if poses and name are counted since 1970."""
        stem = Path(image.name).stem
        if self.epoch_s and re.fullmatch(r"[0-9]{9,19}(\.[0-9]{0,9})?", stem):
            for unit_s in UNITS_S:
                if float(stem) * unit_s >= EPOCH_S:
                    return float(stem) * unit_s - self.epoch_s
        return image.time_s

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


def _natural(name: str) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d{1,18})", name)  # text and digits by turns
    return [int(part) if k % 2 else part.casefold() for k, part in enumerate(parts)], name


def asked_of(camera: CameraConfig) -> Asked:
    """What a configuration says about the file of the poses."""
    return Asked(format=camera.poses_format, axes=camera.pose_convention, direction=camera.poses_direction,
                 quaternion=camera.poses_quaternion, up=camera.poses_up, scale=camera.poses_scale,
                 original=camera.poses_original)


def read_poses(path: Path, convention: Axes | None = None, asked: Asked | None = None) -> Poses:
    """Reads the poses of a file or folder, and converts them from `convention` to OpenGL.

    `asked` says more about the file than its convention. Without either, the format decides: JSON lines are OpenGL and
    TUM trajectories are OpenCV. Raises SaccadeError if the file cannot be read. Raises SaccadeError with file:line or
    the frame if one is damaged, has no valid rotation, or repeats another.
    """
    read = read_trajectory(path, asked or Asked(axes=convention))
    notes = () if read.usual else (read.told, *read.notes)
    table: dict[Key, Array] = dict(zip(read.keys, read.world_from_camera, strict=True))
    return Poses(table, str(path), read.epoch_s, read.lenses, notes, in_order=read.format in ("transforms", "colmap"))
