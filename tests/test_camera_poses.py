"""Poses from files: by name, index and time, in both conventions; a bad line is named."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.camera.poses import read_poses
from saccade.services.camera.sources import SourceImage
from saccade.shared.world.geometry import INTRINSICS_PX, project, rotation_angle
from saccade.tests.fakes.camera import HERE, THERE, complaint, line, tum, written

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def at(time_s, name="", index=0):
    return SourceImage(np.zeros((1, 1, 3), dtype=np.uint8), index, time_s, name)


def test_json_lines_by_name_index_and_time(tmp_path):
    path = written(tmp_path / "p.jsonl", "# the lab", line(HERE, image="a.png"), "", line(THERE, index=4),
                   line(HERE, time_s=2))
    poses = read_poses(path)
    np.testing.assert_allclose(poses.of(at(9.0, "a.png", 1)), HERE, atol=1e-12)
    np.testing.assert_allclose(poses.of(at(9.0, "b.png", 4)), THERE, atol=1e-12)
    np.testing.assert_allclose(poses.of(at(2.0, "b.png", 5)), HERE, atol=1e-12)
    assert poses.of(at(9.0, "b.png", 5)) is None


def test_a_single_line_without_a_key_holds_for_all_images(tmp_path):
    """A camera on a stand whose pose is known: at all times, without an end."""
    poses = read_poses(written(tmp_path / "p.jsonl", line(HERE)))
    np.testing.assert_allclose(poses.of(at(77.0, "x.png", 5)), HERE, atol=1e-12)
    assert not poses.end_before(at(77.0))


@pytest.mark.parametrize(("kind", "convention", "opencv"), [
    ("json", None, False), ("json", "opencv", True), ("tum", None, True), ("tum", "opengl", False)])
def test_poses_become_opengl(tmp_path, kind, convention, opencv):
    """The same camera, written in either convention: what it looks at is before it, and what is higher is above."""
    stored = HERE @ OPENGL_FROM_OPENCV if opencv else HERE
    path = written(tmp_path / "poses", line(stored, time_s=1.0) if kind == "json" else tum(1.0, stored))
    read = read_poses(path, convention).of(at(1.0))
    np.testing.assert_allclose(read, HERE, atol=1e-8)
    (low, high), depth = project([[0, 0, 0], [0, 0, 0.1]], read, INTRINSICS_PX)
    assert (depth > 0.3).all()
    assert high[1] < low[1]


def test_between_two_times_position_and_rotation_go_evenly(tmp_path):
    """At a quarter of the time a quarter of the way and of the angle, whatever the order of the lines."""
    poses = read_poses(written(tmp_path / "p.txt", "# timestamp tx ty tz qx qy qz qw", tum(10.8, THERE),
                               tum(10.0, HERE)), "opengl")
    quarter = poses.of(at(10.2))
    np.testing.assert_allclose(quarter[:3, 3], 0.75 * HERE[:3, 3] + 0.25 * THERE[:3, 3], atol=1e-8)
    whole = rotation_angle(HERE[:3, :3], THERE[:3, :3])
    assert rotation_angle(HERE[:3, :3], quarter[:3, :3]) == pytest.approx(whole / 4, abs=1e-6)
    assert rotation_angle(quarter[:3, :3], THERE[:3, :3]) == pytest.approx(3 * whole / 4, abs=1e-6)


def test_no_pose_is_made_up_outside_the_times_or_across_a_gap(tmp_path):
    poses = read_poses(written(tmp_path / "p.jsonl", *(line(HERE, time_s=t) for t in (1.0, 1.5, 9.0))))
    known = {0.85: False, 0.95: True, 1.2: True, 1.55: True, 1.7: False, 5.0: False, 8.95: True, 9.05: True, 9.2: False}
    assert {t: poses.of(at(t)) is not None for t in known} == known


def test_a_rotation_of_four_digits_is_made_exact(tmp_path):
    rounded = HERE.round(4)
    read = read_poses(written(tmp_path / "p.jsonl", line(rounded))).of(at(0.0))
    np.testing.assert_allclose(read[:3, :3].T @ read[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(read, HERE, atol=2e-4)


def changed(row, column, value):
    pose = HERE.copy()
    pose[row, column] = value
    return pose


MIRRORED = HERE @ np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(("bad", "words"), [
    ("{", "not JSON"), ("[1, 2]", "give {"), (line(colour=3), "unknown key 'colour'"),
    (line(index=3, image="c.png"), "give {"), ('{"index": 3}', "give {"), (line(index=True), "not a number"),
    (line(image=3), "not a text"), (line(time_s="1"), "not a number"), (line(time_s=float("nan")), "not finite"),
    (line(np.eye(3), index=3), "not 4x4"), ('{"index": 3, "world_from_camera": [[1, 2], [3]]}', "not 4x4"),
    (line(changed(0, 3, np.inf), index=3), "not finite"), (line(HERE.T, index=3), "transposed"),
    (line(changed(0, 0, 0.9), index=3), "not orthonormal"), (line(MIRRORED, index=3), "determinant -1"),
    (line(index=1), "a second pose for index 1"), (line(), "holds for all images")])
def test_a_bad_json_line_is_named(tmp_path, bad, words):
    path = written(tmp_path / "p.jsonl", "# poses", line(index=1), bad)
    message = complaint(read_poses, path)
    assert message.startswith(f"poses {path}:3: ")
    assert words in message


@pytest.mark.parametrize(("bad", "words"), [
    ("1 2 3", "the eight numbers of TUM"), ("1 0 0 0 0 0 0 one", "the eight numbers"),
    ("1 0 0 nan 0 0 0 1", "not finite"), ("1 0 0 0 0 0 0 2", "quaternion has length 2.000"),
    (tum(0.5, HERE), "a second pose for time_s 0.5")])
def test_a_bad_tum_line_is_named(tmp_path, bad, words):
    path = written(tmp_path / "p.txt", tum(0.5, HERE), bad)
    message = complaint(read_poses, path)
    assert message.startswith(f"poses {path}:2: ")
    assert words in message


def test_a_pose_file_without_poses_is_refused(tmp_path):
    assert "cannot be read" in complaint(read_poses, tmp_path / "nowhere")
    assert "holds no pose" in complaint(read_poses, written(tmp_path / "empty", "# nothing", ""))
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00\xd8")
    assert "not a text" in complaint(read_poses, tmp_path / "bytes")
