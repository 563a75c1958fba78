"""The rehearsal's camera with faults: where the boards lie, and that a film of them gives poses and usable images."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2")

from saccade.benchmarks.board_scene import Film
from saccade.benchmarks.hand_eyes import BOARDS, CLEAR_M, FOCAL_WRONG, Filmed, as_jpeg, exposure, lay, sheets
from saccade.services.simulator.scenes import generate_split
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.world.geometry import look_at, rotation_angle

MESHES = {name: load_mesh("pantry", name) for name in names_of("pantry")}
SCENES = generate_split({name: mesh.size_m for name, mesh in MESHES.items()}, seed=3, repeats=1, yaw="fixed")


def test_boards_lie_beside_the_objects_and_one_another():
    for scene in SCENES[::5]:
        places = lay(scene, MESHES)
        assert len(places) >= 2
        assert places[0][2] == 0.0
        boxes = [(np.array([x, y]), BOARDS[k].size_m[::-1] / 2 if turn else BOARDS[k].size_m / 2)
                 for k, (x, y, turn) in enumerate(places)]
        for k, (middle, half) in enumerate(boxes):
            for placed in scene.on_table:
                radius = float(np.hypot(*MESHES[placed.name].size_m[:2])) / 2
                gap = np.linalg.norm(np.maximum(np.abs(np.array(placed.center_m[:2]) - middle) - half, 0.0))
                assert gap > radius + CLEAR_M
            assert all((np.abs(middle - other) >= half + wide - 1e-9).any() for other, wide in boxes[:k])


def test_an_exposure_ends_at_the_pose_and_goes_back_along_the_way():
    before, now = look_at((0.5, 0.0, 0.4), np.zeros(3)), look_at((0.5, 0.02, 0.4), np.zeros(3))
    poses = exposure(before, now)
    away_m = [float(np.linalg.norm(pose[:3, 3] - now[:3, 3])) for pose in poses]
    assert sorted(away_m, reverse=True) == away_m
    assert 0 < away_m[-1] < away_m[0] < 0.12 * 0.02 + 1e-9
    assert rotation_angle(poses[0][:3, :3], now[:3, :3]) < rotation_angle(before[:3, :3], now[:3, :3])


def test_a_film_of_boards_gives_poses_that_are_wrong_by_as_much_as_the_lens():
    scene = next(one for one in SCENES if len(one.on_table) == 2)
    film = Film((*(MESHES[p.name] for p in scene.on_table), *sheets()), 700)
    eyes = Filmed(film, scene, MESHES, np.random.default_rng(0))
    x, y, _ = lay(scene, MESHES)[0]
    camera = look_at((x + 0.3, y, 0.4), (x, y, 0.0))
    rgb, measured = eyes.look(camera, camera, 0.0)
    film.close()
    assert rgb.shape == (480, 480, 3)
    assert measured is not None
    assert measured[:3, 3] == pytest.approx([0.3, 0.0, 0.4], abs=3 * FOCAL_WRONG * 0.5)
    assert (eyes.images, len(eyes.apart_m)) == (1, 1)


def test_jpeg_changes_little():
    rgb = np.tile(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], (64, 1, 3))
    changed = np.abs(as_jpeg(rgb).astype(int) - rgb)
    assert 0 < changed.max() < 20
