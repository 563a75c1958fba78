"""The rehearsal of a printed board: MuJoCo renders it on a table with objects, and a camera with faults films it.

The camera has a lens that distorts, an exposure that blurs, noise, an uneven light, and a video in H.264.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.charuco import Board, grey_of
from saccade.services.camera.trajectories.lens import Lens, lens
from saccade.shared.render.look import load_look
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import Array, direction, look_at, pose, rotation_xyz

BOARD = Board(squares=(7, 10), square_m=0.025, marker_m=0.019)
SIZE = (640, 480)
LENS = lens({"fx": 610.0, "fy": 612.0, "cx": 325.0, "cy": 236.0, "k1": -0.24, "k2": 0.08, "p1": 0.0008, "p2": -0.001,
             "k3": -0.01}, SIZE)
RATE_HZ, EXPOSURE_S, EXPOSURES = 30.0, 0.012, 4
RENDER_PX, RENDER_TANGENT = 1100, 0.66  # side of the rendered image, and how far it sees beside its axis at depth 1
NOISE, CRF = 4.0, "26"  # of 255; the quality of H.264, of which phones use about 20
TEXELS_PER_M, MARGIN_M, THICK_M = 6000.0, 0.01, 0.0005
SHEET_Z_M = -THICK_M / 2 + 0.0001
LOOK = "lamp"
BESIDE = {"coffee_can": (0.17, 0.10), "rice_box": (-0.18, -0.02)}


class Film:
    """A world of these meshes, filmed by a camera with faults."""

    def __init__(self, meshes: tuple[Mesh, ...], render_px: int = RENDER_PX):
        focal = render_px / 2 / RENDER_TANGENT
        self.world = World(meshes, size_px=render_px, intrinsics_px=(focal, focal, render_px / 2, render_px / 2))
        u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        rays = LENS.rays(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(*SIZE[::-1], 2)
        places = (focal * rays + render_px / 2 - 0.5).astype(np.float32)
        self._u, self._v = places[..., 0].copy(), places[..., 1].copy()
        away = (u / SIZE[0] - 0.3) ** 2 + (v / SIZE[1] - 0.3) ** 2
        self._light = (1.0 - 0.35 * away)[..., None]  # it falls towards a corner

    def seen(self, poses: Iterable[Array], rng: np.random.Generator, gain: float = 1.0) -> NDArray[np.uint8]:
        """The image [480, 640, 3] of an exposure during which the camera has these poses [4, 4]. `gain` is how bright
        it is."""
        light = gain * np.mean([cv2.remap(self.world.render(one), self._u, self._v, cv2.INTER_LINEAR).astype(float)
                         for one in poses], axis=0)
        return np.clip(light * self._light + rng.normal(0, NOISE, light.shape), 0, 255).round().astype(np.uint8)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self.world.close()


class Scene(Film):
    """The board, flat on a table, with two objects beside it."""

    def __init__(self, board: Board = BOARD):
        meshes = (sheet(board), *(load_mesh("pantry", name) for name in BESIDE))
        super().__init__(meshes)
        self.world.set_look(load_look(LOOK))
        self.world.place({"board": ((0.0, 0.0, SHEET_Z_M), 0.0)} | {
            mesh.name: ((*BESIDE[mesh.name], mesh.size_m[2] / 2), 0.6) for mesh in meshes[1:]})


def sheet(board: Board, name: str = "board") -> Mesh:
    """A thin slab with the printed sheet on its top, whose middle lies at SHEET_Z_M."""
    grey = grey_of(board, texels_per_m=TEXELS_PER_M, margin_m=MARGIN_M)
    x, y = board.size_m / 2 + MARGIN_M
    z = THICK_M / 2
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    top, bottom = [(a, b, z) for a, b in corners], [(a, b, -z) for a, b in corners]
    faces = [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)]
    faces += [face for k in range(4) for face in ((4 + k, 4 + (k + 1) % 4, (k + 1) % 4), (4 + k, (k + 1) % 4, k))]
    return Mesh(name, np.array(top + bottom, dtype=np.float32),
                np.array([(0, 0), (1, 0), (1, 1), (0, 1)] + [(0, 0)] * 4, dtype=np.float32),
                np.array(faces, dtype=np.int32), np.repeat(grey[..., None], 3, axis=2))


class Hand:
    """A camera held in a hand that moves around the board: its pose [4, 4] at each time."""

    def __init__(self, rng: np.random.Generator, *, range_m: tuple[float, float] = (0.42, 0.58),
                 elevation_rad: tuple[float, float] = (0.5, 1.35), gaze_m: float = 0.04, rolls_rad: float = 0.3):
        self._start, self._turn = rng.uniform(-np.pi, np.pi), rng.choice([-1, 1]) * rng.uniform(0.1, 0.6)
        self._range, self._elevation = rng.uniform(*range_m), rng.uniform(*elevation_rad)
        self._gaze = np.array([*rng.uniform(-gaze_m, gaze_m, 2), 0.0])
        self._roll = rng.uniform(-rolls_rad, rolls_rad)
        self._phase, self._beat_hz = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(3, 7, (3, 3))

    def at(self, time_s: float) -> Array:
        """The pose at a time, with the tremor of a hand."""
        shake = np.sin(2 * np.pi * self._beat_hz * time_s + self._phase)
        elevation = np.clip(self._elevation + 0.15 * np.sin(1.5 * time_s + self._phase[0, 0]), 0.35, 1.5)
        eye = self._range * direction(self._start + self._turn * time_s, elevation) + 0.0008 * shake[0]
        turn = rotation_xyz(0.003 * shake[1] + (0.0, 0.0, self._roll))
        return look_at(eye, self._gaze + 0.02 * np.sin(time_s + self._phase[2])) @ pose(turn, np.zeros(3))

    def exposure(self, time_s: float) -> list[Array]:
        """Poses during an exposure whose middle is at this time."""
        return [self.at(time_s + EXPOSURE_S * ((k + 0.5) / EXPOSURES - 0.5)) for k in range(EXPOSURES)]


def clip(scene: Scene, hand: Hand, frames: int, rng: np.random.Generator) -> Iterator[NDArray[np.uint8]]:
    """The images of a film."""
    for k in range(frames):
        yield scene.seen(hand.exposure(k / RATE_HZ), rng)


def encode(images: Iterable[NDArray[np.uint8]], out: Path) -> None:
    """Writes a film in H.264."""
    import av

    with av.open(str(out), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(RATE_HZ).limit_denominator(1000))
        stream.width, stream.height = SIZE
        stream.pix_fmt, stream.options = "yuv420p", {"crf": CRF}
        for rgb in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode())


def wrong_by(share: float) -> Lens:
    """The lens with focal lengths that are wrong by a share."""
    fx, fy, cx, cy = LENS.of(SIZE)
    return Lens((fx * (1 + share), fy * (1 + share), cx, cy), SIZE, LENS.distortion)
