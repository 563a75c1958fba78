"""Rigid transforms out of numbers from a file. Whatever is none is refused with ValueError, which says what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from saccade.shared.errors import told
from saccade.shared.world.geometry import Array, pose

MAX_M = 1e5  # from the origin: nothing is seen from further away
ORTHONORMAL = 1e-3  # largest error of R^T R that is accepted: poses are written with four digits or more
UNIT_QUATERNION = 1e-2  # largest error of a quaternion's length that is accepted
LAST_ROW = 1e-9  # largest error of the row 0 0 0 1


def rigid(matrix: ArrayLike, name: str = "world_from_camera") -> Array:
    """A rigid transform [4, 4] whose rotation is made orthonormal. Raises ValueError if the matrix is not rigid."""
    try:
        transform = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        transform = np.empty(0)
    if transform.shape != (4, 4):
        raise ValueError(f"{name} is not 4x4 numbers")
    if not np.isfinite(transform).all():
        raise ValueError(f"{name} is not finite")
    if np.abs(transform).max() > MAX_M:
        raise ValueError(f"{name} has a number beyond {MAX_M:g}")
    if not np.allclose(transform[3], (0, 0, 0, 1), atol=LAST_ROW):
        raise ValueError(f"{name} does not end in the row 0 0 0 1: is it transposed?")
    rotation = transform[:3, :3]
    _require_rotation(rotation)
    u, _, vt = np.linalg.svd(rotation)
    return pose(u @ vt, transform[:3, 3])


def _require_rotation(rotation: Array) -> None:
    square = rotation.T @ rotation
    error = float(np.abs(square - np.eye(3)).max())
    if error > ORTHONORMAL:
        scale = float(np.sqrt(np.trace(square) / 3))
        if scale > ORTHONORMAL and np.abs(square / scale ** 2 - np.eye(3)).max() <= ORTHONORMAL:
            raise ValueError(f"the rotation contains a scale of {scale:.4g}: divide its nine numbers by it, and give "
                             "the scale of the positions as camera.poses_scale")
        raise ValueError(f"the rotation is not orthonormal (R^T R is off by {error:.2g}): give a pure rotation, "
                         "written with at least four digits")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the rotation mirrors (determinant -1): give right-handed axes")


def from_quaternion(position: Sequence[float], quaternion: Sequence[float], order: str) -> Array:
    """The transform [4, 4] of a position [3] and a quaternion [4] in the order `xyzw` or `wxyz`. Raises ValueError if a
    number is not finite or too large, or if the quaternion's length is not 1."""
    numbers = [*position, *quaternion]
    if not np.isfinite(numbers).all():
        raise ValueError("not finite: leave out the frame, or export it again")
    if max(map(abs, numbers)) > MAX_M:
        raise ValueError(f"a number beyond {MAX_M:g}: are the columns in another order?")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > UNIT_QUATERNION:
        raise ValueError(f"the quaternion has length {length:.3f}, not 1: are the columns in another order?")
    ordered = quaternion if order == "xyzw" else [*quaternion[1:], quaternion[0]]
    return pose(Rotation.from_quat(ordered).as_matrix(), position)


def inverse(transforms: Array) -> Array:
    """The inverses of rigid transforms [N, 4, 4]."""
    turned = np.swapaxes(transforms[:, :3, :3], 1, 2)
    return pose(turned, -np.einsum("nij,nj->ni", turned, transforms[:, :3, 3]))


def number(value: Any, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number of JSON, larger than `low` and at most `high`. Raises ValueError if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: {told(value)} is not a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise ValueError(f"{name}: {told(value)} is not finite")
    if not low < result <= high:
        raise ValueError(f"{name}: {result:g} is not between {low:g} and {high:g}")
    return result
