"""What the simulated hand's camera sees, and what is known of where it is: an ideal camera, or a film with its faults
from which printed boards tell the camera's pose."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from saccade.benchmarks.board_scene import MARGIN_M, SHEET_Z_M, SIZE, Film, sheet, wrong_by
from saccade.services.camera.board_poses import BoardPoses
from saccade.services.camera.charuco import Board
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.services.simulator.scenes import Scene
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import Array, pose

POSE_M, POSE_RAD = 0.0007, np.radians(0.06)  # median error of a board's poses (results/benchmarks/board.json)
MEDIAN_OF_THREE = 1.538  # median length of three standard normal numbers
BOARDS = tuple(Board(squares=(7, 10), square_m=0.025, marker_m=0.019, dictionary="4X4_250", first_marker=35 * number)
               for number in range(4))
CLEAR_M = 0.02  # between an object and a sheet
GRID_M = np.arange(-0.40, 0.401, 0.04)  # where a sheet may be laid
FOCAL_WRONG = 0.02
EXPOSURE_OF_A_STEP, EXPOSURES = 0.12, 3  # share of the time between two images; 12 ms at 10 images per second
GAIN, GAIN_HZ = 0.25, 0.3  # the exposure changes by up to this share
JPEG_QUALITY = 80
RENDER_PX = 900


class Eyes(Protocol):
    """A camera in the hand."""

    def look(self, before: Array, now: Array, time_s: float) -> tuple[NDArray[np.uint8], Array | None]:
        """The image [480, 480, 3] for the networks, and the camera's pose [4, 4] as it is measured, None if it is not.
        The camera is at the pose `now`, and was at `before` one image earlier."""


class Ideal:
    """The simulator's image, and a pose that is as inexact as that of a board."""

    def __init__(self, world: World, rng: np.random.Generator):
        self._world, self._rng = world, rng

    def look(self, before: Array, now: Array, time_s: float) -> tuple[NDArray[np.uint8], Array | None]:
        """As `Eyes` says."""
        return self._world.render(now), as_measured(now, self._rng)


def as_measured(camera: Array, rng: np.random.Generator) -> Array:
    """A camera's pose [4, 4] with the error of a board's poses."""
    turned = Rotation.from_rotvec(rng.normal(0, POSE_RAD / MEDIAN_OF_THREE, 3)).as_matrix()
    return pose(turned @ camera[:3, :3], camera[:3, 3] + rng.normal(0, POSE_M / MEDIAN_OF_THREE, 3))


class Filmed:
    """A film of the scene with boards on the table. The lens distorts, the motion blurs, the exposure changes, and
    noise and JPEG are added; what the agent is told of the lens has focal lengths that are 2 % too long.

    `film` holds the objects and the sheets. `found` and `images` count how many images had a pose, `apart_m` how far
    they were off, in the frame of the first board.
    """

    def __init__(self, film: Film, scene: Scene, meshes: dict[str, Mesh], rng: np.random.Generator):
        self._film, self._rng, self._phase = film, rng, rng.uniform(0, 2 * np.pi)
        places = lay(scene, meshes)
        film.world.place({p.name: (p.center_m, p.yaw_rad) for p in scene.on_table} | {
            f"sheet{k}": ((x, y, SHEET_Z_M), yaw) for k, (x, y, yaw) in enumerate(places)}, scene.table_rgb)
        x, y, _ = places[0]  # it is laid without a turn
        self._board_from_world = pose(np.eye(3), (-x, -y, 0.0))
        lens = wrong_by(FOCAL_WRONG)
        self._poses = BoardPoses(BOARDS[0], lens, Path("board.json"), smooth=True, more=BOARDS[1:len(places)])
        self._virtual = VirtualCamera(SIZE, lens=lens)
        self.images, self.apart_m = 0, list[float]()

    def look(self, before: Array, now: Array, time_s: float) -> tuple[NDArray[np.uint8], Array | None]:
        """As `Eyes` says. The pose is in the frame of the first board."""
        gain = 1 + GAIN * np.sin(2 * np.pi * GAIN_HZ * time_s + self._phase)
        rgb = as_jpeg(self._film.seen(exposure(before, now), self._rng, gain))
        measured = self._poses.of(SourceImage(rgb, self.images, time_s))
        self.images += 1
        if measured is not None:
            self.apart_m.append(float(np.linalg.norm(measured[:3, 3] - (self._board_from_world @ now)[:3, 3])))
        return self._virtual.see(rgb), measured


def exposure(before: Array, now: Array) -> list[Array]:
    """Poses [4, 4] during an exposure, of a camera that goes on as it has come."""
    turns = Slerp([0.0, 1.0], Rotation.from_matrix([before[:3, :3], now[:3, :3]]))
    shares = EXPOSURE_OF_A_STEP * ((np.arange(EXPOSURES) + 0.5) / EXPOSURES - 1.0)  # it ends now
    return [pose(turns(1.0 + share).as_matrix(), now[:3, 3] + share * (now[:3, 3] - before[:3, 3]))
            for share in shares]


def as_jpeg(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image as it is after JPEG, which webcams send."""
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "JPEG", quality=JPEG_QUALITY)
    return np.asarray(Image.open(out))


def sheets() -> tuple[Mesh, ...]:
    """The meshes of the boards."""
    return tuple(sheet(board, f"sheet{k}") for k, board in enumerate(BOARDS))


def lay(scene: Scene, meshes: dict[str, Mesh]) -> list[tuple[float, float, float]]:
    """Where a person would lay the boards: x, y (metres) and the turn (radians) of each. The first is as near to the
    middle of the table as the objects let it, and is not turned; the others are as near to the target. A board for
    which there is no room is left out."""
    objects = [(np.array(p.center_m[:2]), float(np.hypot(*meshes[p.name].size_m[:2])) / 2) for p in scene.on_table]
    target, laid = np.array(scene.target_placed.center_m[:2]), list[tuple[Array, Array, float]]()
    for board in BOARDS:
        near = np.zeros(2) if not laid else target
        turns = (0.0,) if not laid else (0.0, np.pi / 2)
        room = [(float(np.linalg.norm(place - near)), place, half, turn)
                for x in GRID_M for y in GRID_M for turn in turns
                for place, half in [(np.array([x, y]), _half(board, turn))]
                if all(_gap(place, half, middle) > radius + CLEAR_M for middle, radius in objects)
                and all((np.abs(place - other) > half + other_half).any() for other, other_half, _ in laid)]
        if room:
            _, place, half, turn = min(room, key=lambda one: one[0])
            laid.append((place, half, turn))
    return [(float(place[0]), float(place[1]), turn) for place, _, turn in laid]


def _half(board: Board, turn: float) -> Array:
    half = board.size_m / 2 + MARGIN_M
    return half[::-1] if turn else half


def _gap(place: Array, half: Array, point: Array) -> float:
    """The distance of a point from a rectangle, in metres."""
    return float(np.linalg.norm(np.maximum(np.abs(point - place) - half, 0.0)))
