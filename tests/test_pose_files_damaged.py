"""Damaged files of poses: one line says what is wrong, where, and what to do."""

from __future__ import annotations

import json
import struct
import zipfile

import numpy as np
import pytest

from saccade.services.camera.trajectories import phones
from saccade.services.camera.trajectories.reading import read_trajectory
from saccade.shared.errors import SaccadeError
from saccade.tests.fakes import pose_files as made
from saccade.tests.fakes.pose_files import GOOD
from saccade.tests.hostile import MANY, complaint, sparse


def replaced(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))
    return path


def line_changed(path, number, change):
    lines = path.read_text().splitlines()
    lines[number - 1] = change(lines[number - 1].replace(",", " ").split())
    path.write_text("\n".join(lines) + "\n")
    return path


def with_word(k, word, between=" "):
    return lambda words: between.join([*words[:k], word, *words[k + 1:]])


TABLES = [
    ("tum", 4, with_word(1, "nan"), "not finite"), ("tum", 3, with_word(7, "one"), "eight numbers of TUM"),
    ("tum", 5, lambda words: " ".join(words[:4]), "eight numbers of TUM"),
    ("tum", 2, lambda words: " ".join([*words[:4], *"0000"]), "the quaternion has length 0.000"),
    ("kitti", 2, with_word(3, "inf"), "not finite"), ("kitti", 6, lambda words: " ".join(words[:11]), "twelve numbers"),
    ("kitti", 3, lambda words: " ".join([*"0000", *words[4:]]), "not orthonormal"),
    ("kitti", 1, lambda words: " ".join([*"2000", *"0200", *"0020"]), "contains a scale of 2"),
    ("kitti", 4, lambda words: " ".join([*"1000", *"0100", "0", "0", "-1", "0"]), "mirrors"),
    ("euroc", 4, with_word(2, "x", ","), "EuRoC"), ("euroc", 3, with_word(0, "5", ","), "goes back"),
    ("euroc", 7, lambda words: ",".join(words[:6]), "EuRoC"),
    ("euroc", 2, lambda words: ",".join([*words[:4], *"0000", "1"]), "the quaternion has length 0.000"),
    ("stray", 5, with_word(0, "3.1", ", "), "the time 3.100000 s goes back"),
    ("stray", 3, with_word(1, "0", ", "), "frame 0 comes after frame 0"),
    ("stray", 4, with_word(5, "nan", ", "), "not finite"),
    ("stray", 7, lambda words: ", ".join(words[:5]), "not 9 numbers")]


@pytest.mark.parametrize(("kind", "number", "change", "what"), TABLES,
                         ids=[f"{kind} {what}" for kind, _, _, what in TABLES])
def test_a_damaged_line_of_a_table_is_named(tmp_path, kind, number, change, what):
    """Numbers are counted from 1, with comments and header."""
    path = GOOD[kind](tmp_path)
    path = path / "odometry.csv" if kind == "stray" else path
    message = complaint(read_trajectory, line_changed(path, number, change))
    assert message.startswith(f"poses {path}:{number}: ")
    assert what in message


def test_a_damaged_camera_matrix_is_named(tmp_path):
    folder = GOOD["stray"](tmp_path)
    (folder / "camera_matrix.csv").write_text("1, 0, 2\n0, 1\n")
    assert "camera_matrix.csv:1: not a matrix of 3x3 numbers" in complaint(read_trajectory, folder)
    (folder / "camera_matrix.csv").write_text("-1, 0, 2\n0, 1, 2\n0, 0, 1\n")
    assert "no camera has the intrinsics (-1, 1, 2, 2) px" in complaint(read_trajectory, folder)


def tree_changed(path, change):
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))
    return path


def scaled(tree):
    matrix = np.array(tree["frames"][2]["transform_matrix"])
    matrix[:3, :3] *= 1.2
    tree["frames"][2]["transform_matrix"] = matrix.tolist()


TREES = [
    (lambda tree: tree["frames"][3]["transform_matrix"][0].pop(), ", frame 3: transform_matrix is not 4x4 numbers"),
    (lambda tree: tree["frames"][1].pop("transform_matrix"), ", frame 1: it has no transform_matrix"),
    (lambda tree: tree["frames"][4].update(file_path="b/view_1.png"), ", frame 4: a second pose for image view_1.png"),
    (lambda tree: tree["frames"][4].update(file_path=7), ", frame 4: file_path: 7 is not the name of a file"),
    (lambda tree: tree["frames"][4].pop("file_path"), "some frames have a file_path and some have none"),
    (lambda tree: tree["frames"].__setitem__(5, 3), ", frame 5: it has no transform_matrix"),
    (lambda tree: tree.update(frames=[]), "hold no pose"), (lambda tree: tree.update(frames={}), "hold no pose"),
    (scaled, ", frame 2: the rotation contains a scale of 1.2"),
    (lambda tree: tree["frames"][0].update(fl_x="600"), ", frame 0: fl_x: '600' is not a number"),
    (lambda tree: tree.update(fl_x=-1), "no camera has the intrinsics"),
    (lambda tree: tree.update(w=10 ** 400), "0 is not finite"),
    (lambda tree: tree.update(k1=float("nan")), "k1: nan is not finite"),
    (lambda tree: tree.update(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' is not read"),
    (lambda tree: tree.update(applied_transform=[[1, 0], [0, 1]]), "applied_transform is not 4x4 numbers")]


@pytest.mark.parametrize(("change", "what"), TREES, ids=[what for _, what in TREES])
def test_a_damaged_transforms_json_is_refused(tmp_path, change, what):
    path = tree_changed(GOOD["transforms"](tmp_path), change)
    message = complaint(read_trajectory, path)
    assert message.startswith(f"poses {path}")
    assert what in message


def test_json_that_is_cut_or_another_kind_is_refused(tmp_path):
    path = GOOD["transforms"](tmp_path)
    path.write_text(path.read_text()[:-20])
    assert "are not whole JSON" in complaint(read_trajectory, path)
    path.write_text('{\n "frames": ' + "[" * MANY)
    assert "nested deeper" in complaint(read_trajectory, path)


@pytest.mark.parametrize(("number", "change", "what"), [
    (5, with_word(2, "nan"), "not finite"), (3, lambda words: " ".join(words[:8]), "not an image"),
    (7, lambda words: " ".join([words[0], *"0000", *words[5:]]), "the quaternion has length 0.000"),
    (4, lambda words: "2 1 0 0 0 0 0 0 1 b.png", "not the points of an image"),
    (9, with_word(9, "view_1.png"), "a second pose for image view_1.png"),
    (5, with_word(8, "7"), "is of camera 7, which the cameras file does not have"),
    (5, lambda words: "1 " * 3000, "a line of more than 4096 characters")])
def test_a_damaged_images_txt_is_refused(tmp_path, number, change, what):
    path = line_changed(GOOD["colmap"](tmp_path) / "images.txt", number, change)
    message = complaint(read_trajectory, path)
    assert message.startswith(f"poses {path}")
    assert what in message
    if "second pose" not in what and "of camera" not in what:
        assert f":{number}: " in message


@pytest.mark.parametrize(("camera", "what"), [
    ("1 FOV 640 480 610 620 325 238 0.9", ":2: the camera model 'FOV' is not read"),
    ("1 PINHOLE 640 480 610 620", ":2: PINHOLE has 4 parameters (fx, fy, cx, cy), not 2"),
    ("1 PINHOLE 640 480 nan 620 325 238", ":2: the intrinsics are not finite"),
    ("1 PINHOLE 0 480 610 620 325 238", ":2: no image has 0x480 pixels"), ("PINHOLE", ":2: not a camera")])
def test_a_damaged_cameras_txt_is_named(tmp_path, camera, what):
    assert what in complaint(read_trajectory, made.colmap_text(tmp_path / "model", camera))


FIRST = 8 + struct.calcsize("<I7dI")  # where the first image's name begins


@pytest.mark.parametrize(("change", "what"), [
    (lambda data: data[:-30], ", image 5: the file ends too early"),
    (lambda data: data[:5], ": the file ends too early"),
    (lambda data: struct.pack("<Q", 2 ** 60) + data[8:], f"it tells of {2 ** 60} entries"),
    (lambda data: data[:12] + struct.pack("<4d", 0, 0, 0, 0) + data[44:], ", image 0: the quaternion has length 0.000"),
    (lambda data: data[:12] + struct.pack("<d", float("nan")) + data[20:], ", image 0: not finite"),
    (lambda data: data[:FIRST] + b"\xff\0" + data[FIRST + 2:], ", image 0: the name of the image is not UTF-8"),
    (lambda data: data[:FIRST] + b"x" * 5000, ", image 0: the name of the image has no end"),
    (lambda data: data[:FIRST] + b"a\0" + b"\xff" * 8 + data[FIRST:], ", image 0: the file ends too early"),
    (lambda data: data + b"more", "more follows after its 6 images"),
    (lambda data: struct.pack("<Q", 0), "holds no pose")])
def test_a_damaged_images_bin_is_refused(tmp_path, change, what):
    path = GOOD["colmap binary"](tmp_path) / "images.bin"
    path.write_bytes(change(path.read_bytes()))
    message = complaint(read_trajectory, path)
    assert message.startswith(f"poses {path}")
    assert what in message


@pytest.mark.parametrize(("change", "what"), [
    (lambda data: data[:-8], ", camera 0: the file ends too early"),
    (lambda data: struct.pack("<Q", 10 ** 9), "it tells of 1000000000 entries"),
    (lambda data: data[:12] + struct.pack("<i", 77) + data[16:], ", camera 0: the camera model 'number 77'")])
def test_a_damaged_cameras_bin_is_refused(tmp_path, change, what):
    path = GOOD["colmap binary"](tmp_path) / "cameras.bin"
    path.write_bytes(change(path.read_bytes()))
    assert what in complaint(read_trajectory, path)


@pytest.mark.parametrize(("more", "what"), [
    ({"poses": []}, "hold no pose"), ({"poses": [[0, 0, 0, 1, 0, 0]]}, ", frame 0: not seven numbers"),
    ({"poses": [[0, 0, 0, 1, 0, 0, 0], [0] * 7]}, ", frame 1: the quaternion has length 0.000"),
    ({"poses": [[0, 0, 0, 1, 0, 0, None]]}, ", frame 0: poses: None is not a number"), ({"K": [1, 2]}, "K: [1, 2]"),
    ({"frameTimestamps": [0.0, 0.1, 0.2, 0.15, 0.3, 0.4]}, "frame 3: the time 0.150000 s goes back"),
    ({"fps": 0}, "fps: 0 is not between"),
    ({"perFrameIntrinsicCoeffs": [[1, 2]] * 6}, "intrinsics: [1, 2] are neither four numbers nor nine")])
def test_a_damaged_record3d_is_refused(tmp_path, more, what):
    path = made.record3d(tmp_path / "a.r3d", **more)
    message = complaint(read_trajectory, path)
    assert message.startswith(f"poses {path}")
    assert what in message


def test_an_archive_that_is_no_record3d_is_refused(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../metadata", "{}")
    assert "is an archive without metadata" in complaint(read_trajectory, path)
    path.write_bytes(path.read_bytes()[:40])
    assert "is a damaged archive" in complaint(read_trajectory, path)
    path = GOOD["record3d"](tmp_path)
    path.write_bytes(path.read_bytes().replace(b"metadata", b"metadat\xe4"))
    assert "archive" in complaint(read_trajectory, path)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    """By the size that it tells, and by the size that it has if it lies."""
    monkeypatch.setattr(phones, "MAX_FILE_BYTES", 1000)
    path = tmp_path / "a.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", b"0" * 100_000, zipfile.ZIP_DEFLATED)
    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "open", None)  # nothing is unpacked
        assert "metadata is larger than 1000 bytes" in complaint(read_trajectory, path)
    told = struct.pack("<I", 100_000)
    path.write_bytes(path.read_bytes().replace(told, struct.pack("<I", 10)))
    assert "is a damaged archive" in complaint(read_trajectory, path)
    monkeypatch.setattr(phones, "MAX_LIST_BYTES", 40)
    assert "is a damaged archive (a part is larger than 40 bytes)" in complaint(read_trajectory, path)


@pytest.mark.parametrize("name", ["transforms.json", "a.txt", "images.txt", "images.bin", "data.csv", "odometry.csv"])
def test_a_file_that_is_empty_huge_or_of_another_kind_is_refused(tmp_path, name):
    path = tmp_path / name
    for content in (b"", b"\n\n", b"\x80\x04\x95pickle", b"\x89PNG\r\n\x1a\n", b"what is this\n", b"\0" * 64, b"{}",
                    b"[]"):
        path.write_bytes(content)
        assert complaint(read_trajectory, path).startswith(f"poses {path}")
    assert complaint(read_trajectory, sparse(path, 2 ** 41)).startswith(f"poses {path} is larger than ")


def test_random_damage_gives_poses_or_one_line(tmp_path):
    """Whatever a byte is changed to: nothing but a trajectory or a SaccadeError comes out."""
    rng, refusals = np.random.default_rng(0), []
    for kind, make in GOOD.items():
        (tmp_path / kind).mkdir()
        path = make(tmp_path / kind)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        for file in files:
            whole = file.read_bytes()
            for _ in range(40):
                data = bytearray(whole)
                for at in rng.integers(0, len(data), 3):
                    data[at] = rng.integers(0, 256)
                file.write_bytes(bytes(data[:rng.integers(1, len(data))] if rng.random() < 0.3 else data))
                try:
                    read = read_trajectory(path)
                except SaccadeError as error:
                    refusals.append(str(error))
                else:
                    assert np.isfinite(read.world_from_camera).all()
            file.write_bytes(whole)
    assert len(refusals) > 100
    assert all(text.startswith("poses ") and text.isprintable() for text in refusals)


def test_a_folder_of_nothing_known_says_what_it_looks_for(tmp_path):
    assert "odometry.csv, transforms.json, images.bin" in complaint(read_trajectory, tmp_path)


def test_poses_never_open_the_images_that_they_name(tmp_path):
    """A file_path that leads out of the folder is a name and no more."""
    path = GOOD["transforms"](tmp_path)
    replaced(path, "./images/view_0.png", "../../../../dev/zero")
    assert read_trajectory(path).names[0] == "zero"
