"""Smooths the poses of a moving camera: a Kalman filter of position, rotation and their velocities.

The camera may accelerate in any way; a measured pose that it could hardly have reached is refused.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from saccade.services.camera.board_pose import Measured
from saccade.shared.world.geometry import Array, pose, rotation_angle

MAX_GAP_S = 1.0  # after a longer time without a pose, the next begins a new track
ACCELERATION_M, ACCELERATION_RAD = 1.5, 6.0  # standard deviations, per second squared, of a camera held in a hand
VELOCITY_M, VELOCITY_RAD = 0.6, 1.5  # standard deviations of the first velocity, per second
FLOOR_M, FLOOR_RAD = 0.0007, 0.0015  # of a measured pose: what the lens and the print are wrong by
GATE = 33.1  # chi squared of six numbers that one measurement in 100,000 exceeds
RETURNS = 3  # measurements in a row that agree with one another and not with the track begin a new one
NEAR_M, NEAR_RAD = 0.1, 0.3  # within which refused measurements agree


class PoseFilter:
    """Takes measured poses in the order of their times, and returns them smoothed.

    The state [12] is the position, the velocity, the rotation from a reference (radians about the world's axes) and the
    angular velocity. `refused` counts what did not fit.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._filter: Any = None
        self._reference = np.eye(3)
        self.forget()

    def forget(self) -> None:
        """Begins anew."""
        self._time_s: float | None = None
        self._kept: list[Measured] = []

    @property
    def covariance(self) -> Array:
        """The covariance [6, 6] of the newest pose: position (metres) and rotation about the world's axes (radians)."""
        chosen = [0, 1, 2, 6, 7, 8]
        return np.asarray(self._filter.P[np.ix_(chosen, chosen)])

    def take(self, time_s: float, measured: Measured) -> Array | None:
        """Returns the smoothed pose world_from_camera [4, 4], or None if the measurement is refused."""
        if self._time_s is None or not 0 < time_s - self._time_s <= MAX_GAP_S:
            return self._begin(time_s, measured)
        before = self._filter.x.copy(), self._filter.P.copy()
        self._predict(time_s - self._time_s)
        distance = self._innovation(measured)
        if distance > GATE:
            self._filter.x, self._filter.P = before
            self.refused += 1
            agree = not self._kept or _agree(self._kept[-1], measured)
            self._kept = [*self._kept, measured] if agree else [measured]
            return self._begin(time_s, measured) if len(self._kept) >= RETURNS else None
        self._filter.update(self._measurement(measured), R=_noise(measured))
        self._reference = Rotation.from_rotvec(self._filter.x[6:9]).as_matrix() @ self._reference
        self._filter.x[6:9] = 0.0
        self._time_s, self._kept = time_s, []
        return pose(self._reference, self._filter.x[:3])

    def _begin(self, time_s: float, measured: Measured) -> Array:
        self._time_s, self._kept = time_s, []
        self._reference = measured.world_from_camera[:3, :3]
        self._filter = KalmanFilter(dim_x=12, dim_z=6)
        self._filter.x = np.zeros(12)
        self._filter.x[:3] = measured.world_from_camera[:3, 3]
        self._filter.H = np.zeros((6, 12))
        self._filter.H[:3, :3] = self._filter.H[3:, 6:9] = np.eye(3)
        self._filter.P = np.diag(np.repeat([0.0, VELOCITY_M, 0.0, VELOCITY_RAD], 3) ** 2)
        measured_at = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])
        self._filter.P[measured_at] = _noise(measured)
        return measured.world_from_camera

    def _predict(self, dt_s: float) -> None:
        step = np.eye(12)
        step[:3, 3:6] = step[6:9, 9:12] = dt_s * np.eye(3)
        noise = np.zeros((12, 12))
        moved = np.array([[dt_s ** 4 / 4, dt_s ** 3 / 2], [dt_s ** 3 / 2, dt_s ** 2]])
        for first, acceleration in ((0, ACCELERATION_M), (6, ACCELERATION_RAD)):
            noise[first:first + 6, first:first + 6] = acceleration ** 2 * np.kron(moved, np.eye(3))
        self._filter.predict(F=step, Q=noise)

    def _measurement(self, measured: Measured) -> Array:
        turn = Rotation.from_matrix(measured.world_from_camera[:3, :3] @ self._reference.T)
        return np.concatenate([measured.world_from_camera[:3, 3], turn.as_rotvec()])

    def _innovation(self, measured: Measured) -> float:
        """The squared Mahalanobis distance of a measurement from what was predicted."""
        rest = self._measurement(measured) - self._filter.H @ self._filter.x
        spread = self._filter.H @ self._filter.P @ self._filter.H.T + _noise(measured)
        return float(rest @ np.linalg.solve(spread, rest))


def _noise(measured: Measured) -> Array:
    return measured.covariance + np.diag(np.repeat([FLOOR_M, FLOOR_RAD], 3) ** 2)


def _agree(one: Measured, other: Measured) -> bool:
    a, b = one.world_from_camera, other.world_from_camera
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < NEAR_M and rotation_angle(a[:3, :3], b[:3, :3]) < NEAR_RAD)
