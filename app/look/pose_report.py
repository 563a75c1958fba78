"""Says in lines what a file of poses holds, so that one sees whether it was understood."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from saccade.services.camera.trajectories.lens import one_lens
from saccade.services.camera.trajectories.trajectory import NAMES, Trajectory
from saccade.shared.errors import SaccadeError, printable

_KEYS = ("camera.poses_format, camera.pose_convention, camera.poses_direction, camera.poses_quaternion, "
         "camera.poses_up and camera.poses_scale")


def report(read: Trajectory) -> Iterator[str]:
    """Yields lines about the format, the number of poses, their times, their extent, the lens and the conventions."""
    count = len(read.keys)
    yield f"format: {NAMES[read.format]}"
    yield f"poses: {count}{_span(read)}"
    yield from _extent(read)
    yield _lens(read)
    yield f"conventions: {read.told.split('; ', 1)[1]}"
    for note in read.notes:
        yield f"note: {note}"
    yield f"if this is wrong, override it with {_KEYS}"


def _span(read: Trajectory) -> str:
    parts = []
    if read.names:
        parts.append(f"{printable(read.names[0], 100)} to {printable(read.names[-1], 100)}")
    if read.numbers:
        parts.append(f"frames {min(read.numbers)} to {max(read.numbers)}")
    if read.times_s is not None and len(read.times_s):
        low, high = float(read.times_s.min()), float(read.times_s.max())
        parts.append(f"{low:.3f} to {high:.3f} s, which is {high - low:.3f} s")
    return f" ({'; '.join(parts)})" if parts else ""


def _extent(read: Trajectory) -> Iterator[str]:
    positions = read.world_from_camera[:, :3, 3]
    low, high = positions.min(0), positions.max(0)
    told = ", ".join(f"{axis} {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", low, high, strict=True))
    path_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    yield f"extent: {told} m; the path is {path_m:.3f} m long"
    rotations = read.world_from_camera[:, :3, :3]
    upright, down = int((rotations[:, 2, 1] > 0).sum()), int((rotations[:, 2, 2] > 0).sum())
    below = int((positions[:, 2] < 0).sum())
    count = len(positions)
    yield (f"cameras: {upright} of {count} are upright, {down} of {count} look downwards, {below} of {count} are below "
           "the table's top")


def _lens(read: Trajectory) -> str:
    try:
        lens, note = one_lens(read.lenses)
    except SaccadeError as error:
        return f"intrinsics: {error}"
    if lens is None:
        return "intrinsics: the file has none"
    if lens.intrinsics_px is None:
        return f"intrinsics: a horizontal field of view of {np.degrees(lens.angle_x_rad or 0.0):.1f} degrees"
    size = f", images of {lens.size_px[0]}x{lens.size_px[1]} pixels" if lens.size_px else ""
    told = ", ".join(f"{x:.2f}" for x in lens.intrinsics_px)
    removed = f"; {lens.note()}, is removed" if lens.distorts else ""
    return f"intrinsics: {told} px{size}{f'; {note}' if note else ''}{removed}"
