"""Poses from the files of other programs in the camera service, and `saccade poses show`."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from saccade.app.look import pose_picture
from saccade.services.camera.core import build
from saccade.services.camera.poses import read_poses
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories.lens import lens
from saccade.services.camera.trajectories.reading import read_trajectory
from saccade.services.camera.trajectories.trajectory import Asked
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.shared.config import Config
from saccade.tests.fakes import pose_files as made
from saccade.tests.fakes.camera import folder_of
from saccade.tests.fakes.pose_files import COUNT, GOOD, LENS, NAMES, SIZE, TRUE
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
    assert any(note.endswith("pixels at the image's corner, is removed") for note in camera.notes)
    assert not any("intrinsics_px is not given" in note for note in camera.notes)
    assert camera.virtual_camera.coverage == VirtualCamera((320, 240), lens=camera.poses.lens((320, 240))[0]).coverage
    assert camera.virtual_camera.coverage != VirtualCamera((320, 240)).coverage
    own = camera_of(images, path, intrinsics_px=[300, 300, 160, 120])
    assert not any(note.startswith("intrinsics") for note in own.notes)
    assert any("is not removed, because camera.intrinsics_px is given" in note for note in own.notes)
    square = folder_of(tmp_path / "g", NAMES, size=(240, 240))
    assert "for images of 640x480 pixels" in complaint(camera_of, square, path)


def test_intrinsics_of_an_unknown_size_are_taken_and_said(tmp_path):
    """Stray Scanner's matrix is for the images of its video: smaller ones would be seen wrongly."""
    names = [f"{k}.png" for k in range(2 * COUNT)]
    camera = camera_of(folder_of(tmp_path / "f", names, size=SIZE), GOOD["stray"](tmp_path))
    np.testing.assert_allclose(poses_seen(camera), TRUE, atol=1e-6)
    assert any("does not tell their size: 640x480 pixels are taken" in note for note in camera.notes)


def test_the_camera_tells_of_its_own_format_only_what_was_asked(tmp_path):
    images, path = folder_of(tmp_path / "f", NAMES, size=SIZE), GOOD["json-lines"](tmp_path)
    assert not any(note.startswith("poses ") for note in camera_of(images, path).notes)
    assert any("one unit is 0.5 m" in note for note in camera_of(images, path, poses_scale=0.5).notes)
    turned = camera_of(images, path, poses_direction="camera_from_world")
    assert any("camera_from_world" in note for note in turned.notes)


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


def test_the_order_of_names_is_that_of_their_numbers(tmp_path):
    """`9.png` comes before `10.png`, whatever the order in the file."""
    path = GOOD["transforms"](tmp_path)
    text = path.read_text()
    for k, name in enumerate(NAMES):
        text = text.replace(name, f"{(9, 10, 8, 100, 7, 11)[k]}.png")
    path.write_text(text)
    poses = read_poses(path)
    blank = np.zeros((1, 1, 3), dtype=np.uint8)
    for k, place in enumerate((4, 2, 0, 1, 5, 3)):
        np.testing.assert_allclose(poses.of(SourceImage(blank, k, 0.1 * k)), TRUE[place], atol=1e-6)


def test_images_of_a_video_are_matched_by_order(tmp_path):
    poses = read_poses(GOOD["transforms"](tmp_path))
    image = SourceImage(np.zeros((1, 1, 3), dtype=np.uint8), 4, 0.4)
    np.testing.assert_allclose(poses.of(image), TRUE[4], atol=1e-6)


# Distortion.

def test_the_distortion_is_told_in_pixels_at_the_corner():
    """A radial k1 moves a pixel by focal length * k1 * r^3; here r^2 = 0.5 at the corners."""
    found = lens({"fx": 400.0, "fy": 400.0, "cx": 200.0, "cy": 200.0, "k1": -0.1}, (400, 400))
    assert found.corner_px() == pytest.approx(400 * 0.1 * 0.5 ** 1.5)
    assert "k1 -0.1" in found.note()
    assert "up to 14.1 pixels at the image's corner" in found.note()
    assert lens({"fx": 400.0, "fy": 400.0, "cx": 200.0, "cy": 200.0, "k1": 0.0}, (400, 400)).note() is None


def test_a_fisheye_without_coefficients_still_differs_from_a_pinhole():
    """It shows an angle a at a distance of a, not of tan a."""
    found = lens({"fx": 400.0, "fy": 400.0, "cx": 400.0, "cy": 400.0}, (800, 800), fisheye=True)
    radius = 2 ** 0.5
    assert found.corner_px() == pytest.approx(400 * (radius - np.arctan(radius)))


def test_a_distortion_that_goes_anywhere_is_told_without_a_number():
    """A damaged coefficient would make infinite pixels."""
    found = lens({"fx": 400.0, "fy": 400.0, "cx": 200.0, "cy": 200.0, "k3": 1e300}, (400, 400))
    assert "more than 100000 pixels" in found.note()


@pytest.mark.parametrize(("numbers", "fisheye"), [
    ({"k1": 0.11, "k2": -0.05, "p1": 0.013, "p2": -0.007}, False),
    ({"k1": 0.11, "k2": -0.05, "p1": 0.01, "p2": 0.02, "k3": 0.03, "k4": 0.2, "k5": 0.04, "k6": 0.01}, False),
    ({"k1": 0.11, "k2": -0.05, "k3": 0.02, "k4": -0.01}, True)], ids=["radial and tangential", "rational", "fisheye"])
def test_the_distortion_at_the_corner_is_that_of_opencv(numbers, fisheye):
    """With all coefficients different, none can take the place of another."""
    cv2 = pytest.importorskip("cv2")
    fx, fy, cx, cy = LENS
    found = lens({"fx": fx, "fy": fy, "cx": cx, "cy": cy, **numbers}, SIZE, fisheye=fisheye)
    corners = np.array([[u, v] for u in (0.0, SIZE[0]) for v in (0.0, SIZE[1])])
    rays = np.hstack([(corners - (cx, cy)) / (fx, fy), np.ones((4, 1))])[:, None]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    seen, _ = project(rays, np.zeros(3), np.zeros(3), matrix, np.array(list(numbers.values())))
    assert found.corner_px() == pytest.approx(np.linalg.norm(seen.reshape(-1, 2) - corners, axis=1).max(), rel=1e-6)


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
    _, out, _ = call(monkeypatch, capsys, "poses", "show", path, "--scale", "2")
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
