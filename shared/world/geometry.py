"""Camera geometry: pinhole projection, look-at poses, spherical viewpoints.

These conventions hold everywhere. Lengths are in metres and angles in radians. The world is right-handed, z points up,
and the table top is at z = 0. The camera follows OpenGL: it looks along its -z axis, +x is right and +y is up. Pixels
are (u, v) = (column, row) of the 480x480 image. `a_from_b` maps points of b to a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

IMAGE_SIZE_PX = 480
# RealSense D435i at 640x480, cropped to the central 480x480, so cx moves by 80 (not so in the published agent).
INTRINSICS_PX = (615.132, 615.221, 326.285 - 80.0, 231.780)  # fx, fy, cx, cy
REFERENCE_RANGE_M = 0.40  # scale 1: the range at which the object views of the paper's dataset are taken


def unit(vectors: ArrayLike) -> Array:
    """Scales vectors [..., 3] to length 1. A zero vector stays zero."""
    vectors = np.asarray(vectors, dtype=np.float64)
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(norm == 0.0, 1.0, norm)


def rotation_towards(forward: ArrayLike) -> Array:
    """Rotations world_from_camera [..., 3, 3] without roll, whose -z axis is `forward` [..., 3].

    Straight up or down, roll is not defined. There the top of the image points to world +x.
    """
    back = -unit(forward)
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    degenerate = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-9
    right = unit(np.where(degenerate, np.array([0.0, -1.0, 0.0]), right))
    return np.stack([right, np.cross(back, right), back], axis=-1)


def rotation_onto(rays: ArrayLike) -> Array:
    """The smallest rotations [..., 3, 3] that turn the optical axis (0, 0, -1) onto unit rays [..., 3].

    A ray must not point straight backwards.
    """
    x, y, z = np.moveaxis(np.asarray(rays, dtype=np.float64), -1, 0)
    share = 1.0 / (1.0 - z)
    return np.stack([np.stack([1.0 - share * x * x, -share * x * y, -x], axis=-1),
                     np.stack([-share * x * y, 1.0 - share * y * y, -y], axis=-1),
                     np.stack([x, y, -z], axis=-1)], axis=-2)


def pose(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Rigid transforms [..., 4, 4] from rotations [..., 3, 3] and positions [..., 3]."""
    rotation = np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*rotation.shape[:-2], 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = position
    result[..., 3, 3] = 1.0
    return result


def look_at(position: ArrayLike, target: ArrayLike) -> Array:
    """Poses world_from_camera [..., 4, 4] at `position` [..., 3] that look at `target` [..., 3], without roll
    (metres)."""
    position = np.asarray(position, dtype=np.float64)
    return pose(rotation_towards(np.asarray(target) - position), position)


def direction(azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Unit vectors [..., 3] from a centre towards (azimuth, elevation), in radians."""
    azimuth, elevation = np.asarray(azimuth), np.asarray(elevation)
    return np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation) + 0.0 * azimuth], axis=-1)


def spherical(position: ArrayLike, center: ArrayLike) -> tuple[Array, Array, Array]:
    """(azimuth, elevation, range) of `position` [..., 3] around `center`: radians, radians, metres."""
    offset = np.asarray(position, dtype=np.float64) - np.asarray(center, dtype=np.float64)
    horizontal = np.hypot(offset[..., 0], offset[..., 1])
    return (np.arctan2(offset[..., 1], offset[..., 0]), np.arctan2(offset[..., 2], horizontal),
            np.linalg.norm(offset, axis=-1))


def wrap(angle: ArrayLike) -> Array:
    """Angles in radians, brought into [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def rotation_angle(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle [...] in radians of the rotation between the rotations a and b [..., 3, 3]."""
    trace = np.einsum("...ij,...ij->...", np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))


def quaternion(rotation: ArrayLike) -> Array:
    """The quaternion (x, y, z, w) of a rotation [3, 3]: the leading eigenvector of Bar-Itzhack's matrix (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    k = np.array([[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
                  [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]]) / 3
    return np.linalg.eigh(k)[1][:, -1]


def rotation_of(quaternion_xyzw: ArrayLike) -> Array:
    """The rotation [3, 3] of a quaternion (x, y, z, w), which need not have length 1."""
    x, y, z, w = np.asarray(quaternion_xyzw, dtype=np.float64) / np.linalg.norm(quaternion_xyzw)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def yaw_rotation(angle: float) -> Array:
    """The rotation [3, 3] by an angle (rad) about the vertical."""
    return rotation_xyz((0.0, 0.0, angle))


def rotation_vector(rotation: ArrayLike) -> Array:
    """The axis of a rotation [3, 3] times its angle in radians, which is at most pi: [3]."""
    turned = quaternion(rotation)
    axis, cosine = (turned[:3], turned[3]) if turned[3] >= 0 else (-turned[:3], -turned[3])
    sine = float(np.linalg.norm(axis))
    return axis * (2 * np.arctan2(sine, cosine) / max(sine, 1e-12))


def pixel_rays(pixels: ArrayLike, intrinsics: ArrayLike) -> Array:
    """Unit rays [..., 3] in the camera's frame through the pixels (u, v) [..., 2]. `intrinsics` are (fx, fy, cx, cy) in
    pixels."""
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    pixels = np.asarray(pixels, dtype=np.float64)
    x, y = (pixels[..., 0] - cx) / fx, -(pixels[..., 1] - cy) / fy
    return unit(np.stack([x, y, -np.ones_like(x)], axis=-1))


def project(points: ArrayLike, world_from_camera: ArrayLike, intrinsics: ArrayLike) -> tuple[Array, Array]:
    """Pixels (u, v) [..., 2] and depths along the optical axis [...] in metres of world points [..., 3].

    `intrinsics` are (fx, fy, cx, cy) in pixels. A point behind the camera has a depth <= 0, and its pixel has no
    meaning.
    """
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    camera = np.asarray(world_from_camera, dtype=np.float64)
    local = (np.asarray(points, dtype=np.float64) - camera[..., :3, 3]) @ camera[..., :3, :3]
    depth = -local[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return np.stack([cx + fx * local[..., 0] / safe, cy - fy * local[..., 1] / safe], axis=-1), depth


def euler_xyz(rotation: ArrayLike) -> Array:
    """Angles (x, y, z) [3] in radians with rotation = Rz(z) Ry(y) Rx(x), for a rotation [3, 3]."""
    r = np.asarray(rotation, dtype=np.float64)
    y = np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))
    if abs(r[2, 0]) > 1.0 - 1e-12:  # gimbal lock: put everything in z
        return np.array([0.0, y, np.arctan2(-r[0, 1], r[1, 1])])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), y, np.arctan2(r[1, 0], r[0, 0])])


def rotation_xyz(angles: ArrayLike) -> Array:
    """The rotation Rz(z) Ry(y) Rx(x) [3, 3] of angles (x, y, z) [3] in radians, about the fixed axes."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.asarray(angles)), np.sin(np.asarray(angles))
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


def fibonacci_hemisphere(count: int) -> tuple[Array, Array]:
    """`count` pairs (azimuth, elevation) in radians, each [count], spread evenly over the upper hemisphere (paper,
    appendix B)."""
    index = np.arange(count) + 0.5
    return wrap(index * np.pi * (3.0 - np.sqrt(5.0))), np.arcsin(1.0 - index / count)


def fibonacci_sphere(count: int) -> Array:
    """`count` unit vectors [count, 3], spread evenly over the whole sphere."""
    azimuth, elevation = fibonacci_hemisphere(count)
    return direction(azimuth, np.arcsin(2.0 * np.sin(elevation) - 1.0))


def circle_around(points: ArrayLike, rounds: int = 60) -> tuple[Array, float]:
    """About the smallest circle around points [N, 2]: its centre [2] and its radius. Each round moves the centre a
    smaller share of the way to the farthest point (Badoiu and Clarkson, 2003)."""
    points = np.asarray(points, dtype=np.float64)
    center = (points.min(0) + points.max(0)) / 2
    for k in range(rounds):
        far = points[np.argmax(((points - center) ** 2).sum(1))]
        center = center + (far - center) / (k + 3)
    return center, float(np.sqrt(((points - center) ** 2).sum(1).max()))


GRID_ELEVATIONS, GRID_AZIMUTHS = 18, 72  # cells of 5 degrees


def viewing_grid() -> tuple[Array, Array]:
    """Centres of the grid's cells on the upper viewing hemisphere: elevations [E] and azimuths [A], in radians."""
    return ((np.arange(GRID_ELEVATIONS) + 0.5) * np.pi / 2 / GRID_ELEVATIONS,
            (np.arange(GRID_AZIMUTHS) + 0.5) * 2 * np.pi / GRID_AZIMUTHS - np.pi)
