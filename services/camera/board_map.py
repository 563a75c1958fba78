"""Where several boards are, and the camera's pose from all of them.

The first board is the world. Where another one is becomes known from images that show it together with one that is
known already; until then it tells nothing. The poses by all known boards in an image are fused, and must agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.services.camera.board_pose import Doubtful, Measured, certain
from saccade.shared.world.geometry import Array, pose, rotation_angle

LOOKS = 6  # chosen: so many images that agree tell where a board is
MOST_LOOKS = 30  # chosen: of them the newest count, while they do not agree
AGREE_M, AGREE_RAD = 0.006, np.radians(1.0)  # chosen: how far images may be from their median, and boards apart
FLOOR_M, FLOOR_RAD = 0.0007, 0.0015  # of one measured pose: what the lens and the print are wrong by
NO_KNOWN = "only boards are seen of which is not known yet where they are: show each together with the first"
DISAGREE = "the boards do not agree about where the camera is: has one of them been moved?"


class BoardMap:
    """The poses of boards on the table, by their numbers, in the frame of the first (number 0)."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._known: dict[int, tuple[Array, Array]] = {0: (np.eye(4), np.zeros((6, 6)))}
        self._looks: dict[int, list[Array]] = {number: [] for number in range(1, count)}

    @property
    def known(self) -> dict[int, Array]:
        """The poses world_from_board [4, 4] that are known, by the boards' numbers."""
        return {number: placed for number, (placed, _) in self._known.items()}

    def fuse(self, seen: Sequence[Measured | Doubtful]) -> Measured | Doubtful:
        """The camera's pose in the world, from its poses in the frames of all boards, in their order.

        Learns where further boards are. The doubt of the first board is told if no board gives a pose.
        """
        measured = {number: one for number, one in enumerate(seen) if isinstance(one, Measured)}
        if not measured:
            return next(one for one in seen if isinstance(one, Doubtful))
        placed = [_moved(*self._known[number], one) for number, one in measured.items() if number in self._known]
        if not placed:
            return Doubtful(NO_KNOWN)
        if not all(_near(one.world_from_camera, other.world_from_camera, 2 * AGREE_M, 2 * AGREE_RAD)
                   for one, other in combinations(placed, 2)):
            return Doubtful(DISAGREE)
        camera = _fused(placed)
        for number, one in measured.items():
            if number not in self._known:
                self._look(number, camera.world_from_camera @ np.linalg.inv(one.world_from_camera))
        return certain(camera)

    def _look(self, number: int, world_from_board: Array) -> None:
        """Takes where a board is by one image. It becomes known when enough images agree."""
        looks = self._looks[number] = [*self._looks[number], world_from_board][-MOST_LOOKS:]
        if len(looks) < LOOKS:
            return
        middle = _median(looks)
        agree = [look for look in looks if _near(look, middle, AGREE_M, AGREE_RAD)]
        if len(agree) < max(LOOKS, 0.7 * len(looks)):
            return
        placed = _median(agree)
        spread = np.array([[*(look[:3, 3] - placed[:3, 3]),
                            *Rotation.from_matrix(look[:3, :3] @ placed[:3, :3].T).as_rotvec()] for look in agree])
        floor = np.diag(np.repeat([FLOOR_M, FLOOR_RAD], 3) ** 2)
        self._known[number] = placed, (spread.T @ spread / len(agree) + floor) / np.sqrt(len(agree))


def _moved(world_from_board: Array, covariance: Array, measured: Measured) -> Measured:
    """A camera's pose in a board's frame, brought into the world. The covariance [6, 6] is that of the board's pose."""
    turn = world_from_board[:3, :3]
    both = np.kron(np.eye(2), turn)
    arm = turn @ measured.world_from_camera[:3, 3]
    lever = np.eye(6)
    lever[:3, 3:] = -_cross(arm)  # what a turn of the board does to the camera's position
    total = both @ measured.covariance @ both.T + lever @ covariance @ lever.T
    return Measured(world_from_board @ measured.world_from_camera, np.asarray(total, dtype=np.float64),
                    measured.rms_px, measured.corners)


def _cross(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _fused(placed: list[Measured]) -> Measured:
    """One pose from several of the same camera, each weighed by its covariance."""
    if len(placed) == 1:
        return placed[0]
    reference = min(placed, key=lambda one: float(np.trace(one.covariance[:3, :3]))).world_from_camera
    floor = np.diag(np.repeat([FLOOR_M, FLOOR_RAD], 3) ** 2)
    information, weighed = np.zeros((6, 6)), np.zeros(6)
    for one in placed:
        turn = Rotation.from_matrix(one.world_from_camera[:3, :3] @ reference[:3, :3].T).as_rotvec()
        weight = np.linalg.inv(one.covariance + floor)
        information += weight
        weighed += weight @ np.concatenate([one.world_from_camera[:3, 3] - reference[:3, 3], turn])
    step = np.linalg.solve(information, weighed)
    camera = pose(Rotation.from_rotvec(step[3:]).as_matrix() @ reference[:3, :3], reference[:3, 3] + step[:3])
    corners = sum(one.corners for one in placed)
    rms_px = float(np.sqrt(sum(one.corners * one.rms_px ** 2 for one in placed) / corners))
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Measured(camera, covariance, rms_px, corners)


def _median(poses: Sequence[Array]) -> Array:
    """The median position and the mean rotation of poses [4, 4]."""
    return pose(Rotation.from_matrix([one[:3, :3] for one in poses]).mean().as_matrix(),
                np.median([one[:3, 3] for one in poses], axis=0))


def _near(one: Array, other: Array, at_most_m: float, at_most_rad: float) -> bool:
    """Whether two poses [4, 4] are no farther apart than this."""
    return bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) <= at_most_m
                and rotation_angle(one[:3, :3], other[:3, :3]) <= at_most_rad)
