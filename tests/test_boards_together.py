"""Several boards: where the others are is learnt, they give poses where the first is not seen, and none where they
disagree."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from saccade.services.camera.board_map import DISAGREE, LOOKS, NO_KNOWN, BoardMap
from saccade.services.camera.board_pose import Doubtful, Measured
from saccade.services.camera.board_poses import BoardPoses
from saccade.services.camera.charuco import read_board, read_boards
from saccade.services.camera.core import require_one_of_each
from saccade.services.camera.sources import SourceImage
from saccade.shared.config import Config
from saccade.shared.world.geometry import pose, rotation_angle
from saccade.tests.fakes.board import PINHOLE, SECOND, SHEET, both_on_the_table, view
from saccade.tests.front_door import call
from saccade.tests.hostile import complaint

pytest.importorskip("cv2")
TURN = Rotation.from_euler("z", 90, degrees=True).as_matrix()
BESIDE = pose(TURN, (0.30, 0.02, 0.0))  # world_from_board of the second
NOISE = np.diag(np.repeat([0.0007, 0.0015], 3) ** 2)


def measured(world_from_camera, world_from_board=None, rng=None) -> Measured:
    """The camera's pose in a board's frame, with noise."""
    board = np.eye(4) if world_from_board is None else world_from_board
    camera = np.linalg.inv(board) @ world_from_camera
    if rng is not None:
        step = rng.multivariate_normal(np.zeros(6), NOISE)
        camera = pose(Rotation.from_rotvec(step[3:]).as_matrix() @ camera[:3, :3], camera[:3, 3] + step[:3])
    return Measured(camera, NOISE, 0.3, 40)


def off_mm(found, true) -> float:
    return 1e3 * float(np.linalg.norm(found.world_from_camera[:3, 3] - true[:3, 3]))


def learnt(rng) -> BoardMap:
    boards = BoardMap(2)
    for azimuth in np.linspace(0, 90, 2 * LOOKS):
        camera = view(azimuth, 50, 0.5, at=(0.15, 0.0))
        boards.fuse([measured(camera, rng=rng), measured(camera, BESIDE, rng)])
    return boards


def test_where_the_second_is_becomes_known_and_it_then_tells_the_pose_alone():
    rng = np.random.default_rng(0)
    boards, unseen = BoardMap(2), Doubtful("fewer than 8 corners")
    camera = view(120, 50, 0.4, at=(0.3, 0.0))
    assert boards.fuse([unseen, measured(camera, BESIDE)]) == Doubtful(NO_KNOWN)
    boards = learnt(rng)
    assert np.linalg.norm(boards.known[1][:3, 3] - BESIDE[:3, 3]) < 0.002
    found = boards.fuse([unseen, measured(camera, BESIDE)])
    assert off_mm(found, camera) < 3
    assert found.covariance[0, 0] > NOISE[0, 0]  # that of where the board is comes on top
    assert boards.fuse([unseen, unseen]) == unseen


def test_two_boards_are_more_exact_than_one_and_a_moved_one_gives_no_pose():
    rng = np.random.default_rng(1)
    boards, single, both = learnt(rng), [], []
    for azimuth in range(0, 180, 6):
        camera = view(azimuth, 50, 0.5, at=(0.15, 0.0))
        one, other = measured(camera, rng=rng), measured(camera, BESIDE, rng)
        single.append(off_mm(one, camera))
        both.append(off_mm(boards.fuse([one, other]), camera))
    assert np.mean(both) < np.mean(single)
    moved = pose(BESIDE[:3, :3], BESIDE[:3, 3] + (0.05, 0.0, 0.0))
    camera = view(20, 50, 0.5)
    assert boards.fuse([measured(camera), measured(camera, moved)]) == Doubtful(DISAGREE)


def test_a_board_that_moves_while_it_is_learnt_stays_unknown():
    boards = BoardMap(2)
    for step in range(2 * LOOKS):
        camera = view(10 * step, 50, 0.5)
        boards.fuse([measured(camera), measured(camera, pose(TURN, (0.3, 0.02 * step, 0.0)))])
    assert list(boards.known) == [0]


def test_images_of_two_boards_give_poses_where_only_the_second_is_seen():
    poses = BoardPoses(SHEET, PINHOLE, Path("a.json"), smooth=False, more=[SECOND])
    for number in range(LOOKS):
        camera = view(230 + 8 * number, 55, 0.5, at=(0.15, 0.0))
        found = poses.of(SourceImage(both_on_the_table(camera), number, number / 10))
        assert np.linalg.norm(found[:3, 3] - camera[:3, 3]) < 0.004
    assert rotation_angle(poses.map.known[1][:3, :3], TURN) < 0.01
    camera = view(300, 60, 0.35, at=(0.36, 0.0))  # the first is out of view
    found = poses.of(SourceImage(both_on_the_table(camera), 9, 0.9))
    assert np.linalg.norm(found[:3, 3] - camera[:3, 3]) < 0.005


def test_sheets_have_their_own_markers_and_boards_that_share_some_are_refused(monkeypatch, capsys, tmp_path):
    for number in (1, 2, 4):
        call(monkeypatch, capsys, "board", "--out", tmp_path / f"{number}.pdf", "--number", number)
    paths = [tmp_path / f"{number}.json" for number in (1, 2, 4)]
    assert [(b.first_marker, b.dictionary) for b in read_boards(paths)] == [
        (0, "4X4_100"), (35, "4X4_100"), (105, "4X4_250")]
    again = tmp_path / "again.json"
    again.write_text(json.dumps(read_board(paths[1]).model_dump(mode="json") | {"dictionary": "4X4_1000"}))
    assert complaint(read_boards, [*paths, again]).startswith(f"boards {paths[1]} and {again} have markers in common")
    lone = Config().with_values({"camera.more_boards": [str(again)]}).camera
    assert "the first board" in complaint(require_one_of_each, lone)
