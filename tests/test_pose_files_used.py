"""Poses from the files of other programs in the camera service, and `saccade poses show`."""

from __future__ import annotations

import numpy as np
from PIL import Image

from saccade.services.camera import pose_picture
from saccade.services.camera.core import build
from saccade.services.camera.poses import read_poses
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories.reading import read_trajectory
from saccade.services.camera.trajectories.trajectory import Asked
from saccade.shared.config import Config
from saccade.tests.fakes import pose_files as made
from saccade.tests.fakes.camera import folder_of
from saccade.tests.fakes.pose_files import COUNT, GOOD, NAMES, SIZE, TRUE
from saccade.tests.front_door import call
from saccade.tests.hostile import complaint


def camera_of(source, poses, **values):
    given = {"source": str(source), "poses": str(poses), **values}
    return build(Config().with_values({f"camera.{key}": value for key, value in given.items()}))


def poses_seen(camera):
    frames = [camera.begin("r", 0)[1].message]
    while found := camera.next_frame():
        frames.append(found[0].message)
    return np.array([frame.world_from_camera for frame in frames])


def test_the_camera_takes_intrinsics_from_the_file(tmp_path):
    """Images of half the size have half the intrinsics; of another shape they are refused; the user's own win."""
    images = folder_of(tmp_path / "f", NAMES, size=(320, 240))
    path = made.transforms(tmp_path / "transforms.json")
    camera = camera_of(images, path)
    np.testing.assert_allclose(poses_seen(camera), TRUE, atol=1e-6)
    assert any("are read as transforms.json" in note for note in camera.notes)
    assert any("intrinsics (305.00, 310.00, 162.50, 119.00) px" in note for note in camera.notes)
    assert any("is not removed yet" in note for note in camera.notes)
    assert not any("intrinsics_px is not given" in note for note in camera.notes)
    own = camera_of(images, path, intrinsics_px=[300, 300, 160, 120])
    assert not any(note.startswith("intrinsics") for note in own.notes)
    square = folder_of(tmp_path / "g", NAMES, size=(240, 240))
    assert "for images of 640x480 pixels" in complaint(camera_of, square, path)


def test_images_of_other_names_are_matched_by_order_if_there_are_as_many(tmp_path):
    path = GOOD["colmap"](tmp_path)
    camera = camera_of(folder_of(tmp_path / "f", [f"{k}.png" for k in range(COUNT)], size=SIZE), path)
    np.testing.assert_allclose(poses_seen(camera), TRUE, atol=1e-6)
    assert any("in the order of their names" in note for note in camera.notes)
    fewer = camera_of(folder_of(tmp_path / "g", [f"{k}.png" for k in range(COUNT - 1)], size=SIZE), path)
    assert "none of the 5 images" in complaint(fewer.begin, "r", 0)


def test_the_ending_of_a_name_does_not_count(tmp_path):
    """Images that were converted after the poses had been found; one of them has no pose."""
    path = GOOD["colmap"](tmp_path)
    names = [name.replace(".png", ".jpg") for name in (*NAMES[1:], "z.png")]
    camera = camera_of(folder_of(tmp_path / "f", names, size=SIZE), path)
    np.testing.assert_allclose(poses_seen(camera), TRUE[1:], atol=1e-6)
    assert camera.skipped == 1


def test_images_of_a_video_are_matched_by_order(tmp_path):
    poses = read_poses(GOOD["transforms"](tmp_path))
    image = SourceImage(np.zeros((1, 1, 3), dtype=np.uint8), 4, 0.4)
    np.testing.assert_allclose(poses.of(image), TRUE[4], atol=1e-6)


# The command.

def test_the_command_says_how_a_file_is_understood(monkeypatch, capsys, tmp_path):
    code, out, _ = call(monkeypatch, capsys, "poses", "show", GOOD["stray"](tmp_path), "--out", tmp_path / "p.png")
    assert code == 0
    for words in ("format: Stray Scanner", "poses: 6 (frames 0 to 10; 3.000 to 4.250 s, which is 1.250 s)",
                  "extent: x 0.350 to 0.500, y 0.100 to 0.650, z 0.250 to 0.809 m", "6 of 6 are upright",
                  "6 of 6 look downwards, 0 of 6 are below", "OpenCV camera axes", "the world's y axis points up",
                  "camera.poses_up", f"written to {tmp_path / 'p.png'}"):
        assert words in out
    with Image.open(tmp_path / "p.png") as picture:
        assert min(picture.size) > 400


def test_a_key_turns_the_cameras_over_and_the_command_shows_it(monkeypatch, capsys, tmp_path):
    """With the wrong axes the cameras look up from their places."""
    path = GOOD["tum"](tmp_path)
    _, out, _ = call(monkeypatch, capsys, "poses", "show", path, "--set", "camera.pose_convention=opengl")
    assert "0 of 6 are upright, 0 of 6 look downwards" in out
    _, out, _ = call(monkeypatch, capsys, "poses", "show", path, "--set", "camera.poses_scale=2")
    assert "x 0.700 to 1.000" in out


def test_the_command_refuses_in_one_line(monkeypatch, capsys, tmp_path):
    (tmp_path / "a.txt").write_text("hello\n")
    code, _, err = call(monkeypatch, capsys, "poses", "show", tmp_path / "a.txt")
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"saccade: poses {tmp_path / 'a.txt'}:1: ")


def test_the_picture_shows_where_the_top_of_the_images_is(tmp_path):
    """The same poses give the same bytes; turned over, they give others; the red edges are there."""
    read = read_trajectory(GOOD["tum"](tmp_path))
    over = read_trajectory(tmp_path / "a.txt", Asked(axes="opengl"))
    for name, shown in (("a", read), ("b", read), ("c", over)):
        pose_picture.draw_poses(shown, tmp_path / f"{name}.png")
    a, b, c = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert a == b != c
    rgb = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert (np.abs(rgb - (0xd1, 0x49, 0x5b)).sum(-1) < 30).sum() > 100
    assert "cannot be written" in complaint(pose_picture.draw_poses, read, tmp_path / "a.xyz")
