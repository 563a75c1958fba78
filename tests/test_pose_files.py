"""Poses from the files of other programs: each format is recognised, and comes out in Saccade's axes."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest

from saccade.services.camera.poses import asked_of, read_poses
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories import colmap, trajectory
from saccade.services.camera.trajectories.lens import Lens, one_lens
from saccade.services.camera.trajectories.reading import read_trajectory
from saccade.services.camera.trajectories.trajectory import Asked
from saccade.shared.config import Config, PosesFormat
from saccade.tests.fakes import pose_files as made
from saccade.tests.fakes.camera import line, written
from saccade.tests.fakes.pose_files import COUNT, FLIP, GOOD, LENS, NAMES, SIZE, TIMES_S, TRUE, Y_UP
from saccade.tests.hostile import complaint


@pytest.mark.parametrize("kind", GOOD)
def test_every_format_gives_the_poses_that_were_written(tmp_path, kind):
    """The camera rises, comes nearer and rolls: no wrong axis, direction or order of numbers gives the same poses."""
    read = read_trajectory(GOOD[kind](tmp_path))
    assert read.format == kind.split()[0]
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)
    assert trajectory.NAMES[read.format] in read.told
    assert f"{COUNT} poses by" in read.told


@pytest.mark.parametrize("kind", GOOD)
def test_a_format_can_be_named_and_another_one_is_refused(tmp_path, kind):
    path = GOOD[kind](tmp_path)
    own = kind.split()[0]
    np.testing.assert_allclose(read_trajectory(path, Asked(format=own)).world_from_camera, TRUE, atol=1e-6)
    assert "poses " in complaint(read_trajectory, path, Asked(format="kitti" if own != "kitti" else "tum"))


def test_the_configuration_names_every_format():
    assert set(get_args(PosesFormat)) == set(trajectory.NAMES)


@pytest.mark.parametrize(("kind", "first"), [("euroc", 0.0), ("tum", 3.0), ("stray", 3.0), ("record3d", 0.0)])
def test_times_are_read_in_seconds(tmp_path, kind, first):
    """EuRoC's are nanoseconds since 1970, and are counted from the first; Record3D tells a rate only."""
    read = read_trajectory(GOOD[kind](tmp_path))
    np.testing.assert_allclose(read.times_s, first + 0.25 * np.arange(COUNT), atol=1e-6)


def test_frames_keep_their_names_and_numbers(tmp_path):
    assert read_trajectory(GOOD["colmap"](tmp_path)).names == tuple(NAMES)
    assert read_trajectory(GOOD["transforms"](tmp_path)).names == tuple(NAMES)
    assert read_trajectory(GOOD["kitti"](tmp_path)).numbers == tuple(range(COUNT))
    assert read_trajectory(GOOD["stray"](tmp_path)).numbers == tuple(range(0, 2 * COUNT, 2))


@pytest.mark.parametrize("kind", ["transforms", "colmap", "colmap binary", "record3d"])
def test_intrinsics_and_size_are_read(tmp_path, kind):
    found, = read_trajectory(GOOD[kind](tmp_path)).lenses
    assert found.intrinsics_px == pytest.approx(LENS)
    assert found.size_px == SIZE


def test_a_stray_scanner_matrix_gives_intrinsics_of_an_unknown_size(tmp_path):
    found, = read_trajectory(GOOD["stray"](tmp_path)).lenses
    assert found.intrinsics_px == LENS
    assert found.size_px is None


# What differs within a format.

@pytest.mark.parametrize(("between", "head", "end"), [
    ("\t", "", "\n"), (",", "timestamp,tx,ty,tz,qx,qy,qz,qw\n", "\n"), (", ", "# a\n\n", "\r\n"),
    (" ", "\ufeff# timestamp tx ty tz qx qy qz qw\r\n", "\r\n"), (" ", "\ufeff", "\n")],
    ids=["tabs", "commas", "windows", "mark and windows", "mark"])
def test_tum_is_read_however_it_is_laid_out(tmp_path, between, head, end):
    read = read_trajectory(made.tum(tmp_path / "a.csv", between, head=head, end=end))
    assert read.format == "tum"
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)


def test_the_header_tells_the_order_of_the_quaternion(tmp_path):
    """And a key tells it where there is no header."""
    numbers = made.rows(TRUE @ FLIP, "wxyz")
    lines = [made.words([t, *row], ",") for t, row in zip(TIMES_S, numbers, strict=True)]
    path = written(tmp_path / "a.csv", "timestamp,x,y,z,qw,qx,qy,qz", *lines)
    np.testing.assert_allclose(read_trajectory(path).world_from_camera, TRUE, atol=1e-6)
    path = written(tmp_path / "b.csv", *lines)
    read = read_trajectory(path, Asked(quaternion="wxyz"))
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)
    assert np.abs(read_trajectory(path).world_from_camera - TRUE).max() > 0.1


def test_the_header_tells_the_order_of_all_columns(tmp_path):
    """Of the position, and of the quaternion before it."""
    numbers = np.array(made.rows(TRUE @ FLIP, "xyzw"))
    lines = [made.words([t, *row], ",") for t, row in zip(TIMES_S, numbers[:, [3, 4, 5, 6, 2, 1, 0]], strict=True)]
    path = written(tmp_path / "a.csv", "timestamp,qx,qy,qz,qw,tz,ty,tx", *lines)
    np.testing.assert_allclose(read_trajectory(path).world_from_camera, TRUE, atol=1e-6)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_times_since_1970_may_have_smaller_units(tmp_path, unit):
    read = read_trajectory(made.tum(tmp_path / "a.txt", times=(TIMES_S + 1_305_031_102.0) * unit))
    np.testing.assert_allclose(read.times_s, TIMES_S - 3.0, atol=1e-3)


def test_nanoseconds_tell_euroc_without_a_header(tmp_path):
    """Its quaternions begin with w, those of TUM end with it."""
    path = made.euroc(tmp_path / "a.csv")
    path.write_text(path.read_text().split("\n", 1)[1])
    read = read_trajectory(path)
    assert read.format == "euroc"
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)


def test_times_since_1970_are_counted_from_the_first(tmp_path):
    """An image is found by its own time, or by a name that is such a time."""
    poses = read_poses(made.tum(tmp_path / "a.txt", times=TIMES_S + 1_305_031_102.0))
    assert poses.epoch_s == pytest.approx(1_305_031_105.0)
    assert any("since 1970" in note for note in poses.notes)
    blank = np.zeros((1, 1, 3), dtype=np.uint8)
    np.testing.assert_allclose(poses.of(SourceImage(blank, 9, 0.5)), TRUE[2], atol=1e-5)
    nanoseconds = read_trajectory(made.tum(tmp_path / "b.txt", times=(TIMES_S + 1_305_031_102.0) * 1e9))
    np.testing.assert_allclose(nanoseconds.times_s, TIMES_S - 3.0, atol=1e-6)
    for name in ("1305031105.750000.png", "1305031105750000000.png", "1305031105750.png"):
        np.testing.assert_allclose(poses.of(SourceImage(blank, 0, 0.0, name)), TRUE[3], atol=1e-5)


def test_lines_of_tum_that_go_back_are_sorted_and_said(tmp_path):
    read = read_trajectory(made.tum(tmp_path / "a.txt", times=[3.0, 3.5, 3.2, 4.0, 4.5, 5.0]))
    assert any("goes back at line 4" in note for note in read.notes)


def test_each_frame_of_transforms_may_have_its_own_lens(tmp_path):
    """A phone's focal length breathes: the median counts, and the user is told."""
    path = made.transforms(tmp_path / "transforms.json")
    tree = json.loads(path.read_text())
    for k, frame in enumerate(tree["frames"]):
        frame["fl_x"] = 600.0 + k
    path.write_text(json.dumps(tree))
    found, note = one_lens(read_trajectory(path).lenses)
    assert found.intrinsics_px[0] == 602.5
    assert "from 600.0 to 605.0 px" in note
    tree["frames"][0]["fl_x"] = 900.0
    path.write_text(json.dumps(tree))
    assert "focal lengths go from 601 to 900 px" in complaint(one_lens, read_trajectory(path).lenses)


def test_intrinsics_that_some_frames_have_are_taken_for_all_and_said(tmp_path):
    path = made.transforms(tmp_path / "transforms.json")
    tree = json.loads(path.read_text())
    common = {name: tree.pop(name) for name in list(tree) if name != "frames"}
    tree["frames"][2] |= common
    path.write_text(json.dumps(tree))
    read = read_trajectory(path)
    assert len(read.lenses) == 1
    assert any("1 of 6 frames have intrinsics: they are taken for all" in note for note in read.notes)


def test_a_field_of_view_gives_the_focal_length_of_any_image(tmp_path):
    """NeRF's own files tell neither a focal length nor a size."""
    tree = {"camera_angle_x": 2 * np.arctan(0.5), "frames": [
        {"file_path": f"./train/r_{k}", "transform_matrix": pose.tolist()} for k, pose in enumerate(TRUE)]}
    (tmp_path / "transforms_train.json").write_text(json.dumps(tree))
    read = read_trajectory(tmp_path / "transforms_train.json")
    assert read.names[1] == "r_1"
    assert read.lenses[0].of((800, 600)) == pytest.approx((800, 800, 400, 300))


def test_an_applied_transform_is_told_and_can_be_undone(tmp_path):
    """nerfstudio exchanges axes before it writes; its matrix has three rows."""
    applied = [[0.0, 1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.2]]
    path = made.transforms(tmp_path / "transforms.json", np.array([*applied, [0, 0, 0, 1]]) @ TRUE,
                           applied_transform=applied)
    kept = read_trajectory(path)
    assert any("applied_transform is kept" in note for note in kept.notes)
    assert np.abs(kept.world_from_camera - TRUE).max() > 0.1
    undone = read_trajectory(path, Asked(original=True))
    np.testing.assert_allclose(undone.world_from_camera, TRUE, atol=1e-6)


MODELS = [("1 SIMPLE_PINHOLE 640 480 610 325 238", 0.0), ("1 PINHOLE 640 480 610 620 325 238", 0.0),
          ("1 SIMPLE_RADIAL 640 480 610 325 238 0.1", 1.0), ("1 RADIAL 640 480 610 325 238 0.1 0.02", 1.0),
          ("1 OPENCV 640 480 610 620 325 238 0.1 0 0.01 0.002", 1.0),
          ("1 OPENCV_FISHEYE 640 480 610 620 325 238 0.1 0 0 0", 1.0)]


@pytest.mark.parametrize(("camera", "distorts"), MODELS, ids=[text.split()[1] for text, _ in MODELS])
def test_models_of_colmap_are_read_as_text_and_binary(tmp_path, camera, distorts):
    text, = read_trajectory(made.colmap_text(tmp_path / "text", camera)).lenses
    number = list(colmap.MODELS).index(camera.split()[1])
    binary, = read_trajectory(made.colmap_binary(tmp_path / "binary", number,
                                                 tuple(map(float, camera.split()[4:])))).lenses
    assert text == binary
    assert text.intrinsics_px[0] == 610.0
    assert text.intrinsics_px[2:] == (325.0, 238.0)
    assert (text.corner_px() > distorts) == bool(distorts)


def test_a_folder_of_colmap_may_lie_in_sparse(tmp_path):
    (tmp_path / "sparse").mkdir()
    made.colmap_binary(tmp_path / "sparse" / "0")
    np.testing.assert_allclose(read_trajectory(tmp_path).world_from_camera, TRUE, atol=1e-6)
    cameras = tmp_path / "sparse" / "0" / "cameras.bin"
    np.testing.assert_allclose(read_trajectory(cameras).world_from_camera, TRUE, atol=1e-6)
    cameras.unlink()
    made.kitti(tmp_path / "transforms.json")
    np.testing.assert_allclose(read_trajectory(tmp_path, Asked(format="colmap")).world_from_camera, TRUE, atol=1e-6)
    (tmp_path / "transforms.json").unlink()
    assert any("no cameras file" in note for note in read_trajectory(tmp_path).notes)


def test_colmap_says_that_unit_and_upright_are_unknown(tmp_path):
    notes = " ".join(read_trajectory(GOOD["colmap"](tmp_path)).notes)
    assert "camera.poses_up" in notes
    assert "camera.poses_scale" in notes


def test_an_older_stray_scanner_has_neither_times_nor_numbers(tmp_path):
    path = made.stray(tmp_path / "scan") / "odometry.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(row.split(", ", 2)[2] for row in lines) + "\n")
    read = read_trajectory(path)
    assert (read.format, read.numbers, read.times_s) == ("stray", tuple(range(COUNT)), None)
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)


def test_a_newer_stray_scanner_has_intrinsics_in_each_line(tmp_path):
    """And empty columns after them; if a line has none, those of the folder count."""
    path = made.stray(tmp_path / "scan") / "odometry.csv"
    head, *lines = path.read_text().splitlines()
    head += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    path.write_text("\n".join([head, *(f"{row}, 1600.0, 1601.0, 959.0, {720 + k}.0, , " for k, row in
                                      enumerate(lines))]))
    read = read_trajectory(path)
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-6)
    assert [found.intrinsics_px for found in read.lenses] == [(1600, 1601, 959, 720 + k) for k in range(COUNT)]
    path.write_text(path.read_text().replace("1600.0, 1601.0, 959.0, 720.0", ", , , "))
    assert [found.intrinsics_px for found in read_trajectory(path).lenses] == [LENS]


def test_record3d_may_have_intrinsics_and_times_of_each_frame(tmp_path):
    """As four numbers, or as a matrix, column by column."""
    stamps = [0.0, 0.1, 0.3, 0.4, 0.6, 0.7]
    for rows in ([[600 + k, 601, 320, 240] for k in range(COUNT)],
                 [[600 + k, 0, 0, 0, 601, 0, 320, 240, 1] for k in range(COUNT)]):
        read = read_trajectory(made.record3d(tmp_path / "a.r3d", perFrameIntrinsicCoeffs=rows, frameTimestamps=stamps))
        assert [found.intrinsics_px for found in read.lenses] == [(600 + k, 601, 320, 240) for k in range(COUNT)]
        np.testing.assert_allclose(read.times_s, stamps)


# What the user says about a file.

UPWARD = {"x": [0, 0, 1], "y": [0, 0, 1], "z": [0, 0, 1], "-x": [0, 0, 1], "-y": [0, 0, 1], "-z": [0, 0, 1]}


@pytest.mark.parametrize("up", UPWARD)
def test_the_axis_that_points_up_becomes_z(tmp_path, up):
    """A camera one metre along that axis stands one metre above the table, and the world stays right-handed."""
    pose = np.eye(4)
    pose["xyz".index(up[-1]), 3] = -1.0 if up.startswith("-") else 1.0
    path = written(tmp_path / "a.jsonl", line(pose, index=0))
    read = read_trajectory(path, Asked(up=up)).world_from_camera[0]
    np.testing.assert_allclose(read[:3, 3], UPWARD[up], atol=1e-12)
    assert np.linalg.det(read[:3, :3]) == pytest.approx(1.0)


def test_scale_and_direction_are_those_that_are_asked(tmp_path):
    stored = TRUE.copy()
    stored[:, :3, 3] *= 1000  # millimetres
    stored = np.linalg.inv(stored)
    path = written(tmp_path / "a.jsonl", *(line(pose, index=k) for k, pose in enumerate(stored)))
    read = read_trajectory(path, Asked(direction="camera_from_world", scale=0.001))
    np.testing.assert_allclose(read.world_from_camera, TRUE, atol=1e-9)


def test_the_configuration_reaches_the_file():
    camera = Config().with_values({
        "camera.poses_format": "tum", "camera.pose_convention": "opengl", "camera.poses_direction": "camera_from_world",
        "camera.poses_quaternion": "wxyz", "camera.poses_up": "-y", "camera.poses_scale": 0.01,
        "camera.poses_original": True}).camera
    assert asked_of(camera) == Asked("tum", "opengl", "camera_from_world", "wxyz", "-y", 0.01, True)
    for key, value in (("poses_up", "w"), ("poses_scale", 0), ("poses_format", "maya"), ("poses_quaternion", "zyxw")):
        assert f"camera.{key}" in complaint(Config().with_values, {f"camera.{key}": value})


def test_what_does_not_fit_the_format_is_refused(tmp_path):
    path = GOOD["kitti"](tmp_path)
    assert "has no quaternions" in complaint(read_trajectory, path, Asked(quaternion="wxyz"))
    assert "no applied_transform" in complaint(read_trajectory, path, Asked(original=True))
    assert "camera.poses_scale 1e+09" in complaint(read_trajectory, path, Asked(scale=1e9))


def test_one_lens_of_none_is_none():
    assert one_lens(()) == (None, None)
    assert one_lens([Lens(LENS, SIZE)] * 3)[0] == Lens(LENS, SIZE)


def test_arkit_axes_are_a_rotation():
    """The test's own axes: a mirror in them would hide a mirror in the code."""
    assert np.linalg.det(Y_UP) == pytest.approx(1.0)
    assert np.linalg.det(made.Y_DOWN) == pytest.approx(1.0)
