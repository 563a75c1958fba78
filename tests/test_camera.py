"""A real camera's episode: goal, frames as the networks know them, their poses, and what is said of assumptions."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import ExifTags, Image

from saccade.app.run.run import resolve
from saccade.services.camera.core import SERVICE, Camera, build
from saccade.services.camera.poses import read_poses
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.shared.bus.messages import Action, Frame
from saccade.shared.bus.wire import decode, encode
from saccade.shared.config import Config
from saccade.shared.world.geometry import INTRINSICS_PX, project
from saccade.shared.world.goal_image import read_goal_image
from saccade.shared.world.task import start_pose
from saccade.tests.fakes.bags import frames_of
from saccade.tests.fakes.camera import HERE, THERE, centroid, complaint, dots, folder_of, line, tum, written


def camera_of(source, **values):
    scene = {key: values.pop(key) for key in ("goal_image", "goal_intrinsics_px", "explore") if key in values}
    return build(Config().with_values({f"camera.{key}": value for key, value in {"source": source, **values}.items()} |
                                      {f"scene.{key}": value for key, value in scene.items()}))


def test_an_episode_begins_with_goal_and_frame_and_ends_with_the_source(tmp_path):
    folder_of(tmp_path / "f", ["a.png", "b.png", "c.png"])
    camera = camera_of(str(tmp_path / "f"), rate_hz=4.0)
    outputs = camera.begin("r", 0)
    assert [output.topic for output in outputs] == [topic for topic in reversed(SERVICE.outputs)]
    assert outputs[0].message.rgb is None
    assert (camera.episodes, camera.period_s) == (1, 0.25)
    frames = frames_of(camera)
    assert [(f.run, f.episode, f.step, int(f.rgb[0, 0, 0])) for f in frames] == [("r", 0, k, k) for k in range(3)]
    assert camera.next_frame() == []
    again = [output.message for output in camera.begin("r", 1)]  # started again
    assert [(m.episode, m.step) for m in again] == [(1, 0), (1, 0)]


def test_every_message_is_valid_on_the_wire(tmp_path):
    camera = camera_of(str(folder_of(tmp_path / "f", ["a.png"])))
    for output in camera.begin("r", 0):
        decode(output.topic.type, encode(output.message))
    frame: Frame = output.message
    assert frame.rgb.shape == (480, 480, 3)
    assert tuple(frame.intrinsics_px) == INTRINSICS_PX


def test_an_action_moves_nothing(tmp_path):
    camera = camera_of(str(folder_of(tmp_path, ["a.png", "b.png"])))
    camera.begin("r", 0)
    move = Action(run="r", episode=0, step=0, translation_m=np.ones(3), rotation_rad=np.zeros(3))
    assert list(camera.step({"action": move})) == []
    np.testing.assert_array_equal(camera.next_frame()[0].message.world_from_camera, start_pose())


def test_images_without_a_pose_are_skipped_and_counted(tmp_path):
    """Steps count what is published, so that nobody waits for a frame that never comes."""
    folder_of(tmp_path / "f", [f"{k}.png" for k in range(5)])
    poses = written(tmp_path / "p.jsonl", line(HERE, image="1.png"), line(THERE, image="3.png"))
    camera = camera_of(str(tmp_path / "f"), poses=poses)
    frames = frames_of(camera)
    assert [(f.step, int(f.rgb[0, 0, 0])) for f in frames] == [(0, 1), (1, 3)]
    np.testing.assert_allclose(frames[1].world_from_camera, THERE, atol=1e-12)
    assert camera.skipped == 3


def test_the_convention_of_poses_is_configured(tmp_path):
    folder_of(tmp_path / "f", ["a.png"])
    poses = written(tmp_path / "p.jsonl", line(HERE @ np.diag([1.0, -1.0, -1.0, 1.0])))
    frame, = frames_of(camera_of(str(tmp_path / "f"), poses=poses, pose_convention="opencv"))
    np.testing.assert_allclose(frame.world_from_camera, HERE, atol=1e-12)


def test_no_overlap_of_times_is_refused_with_both_spans(tmp_path):
    folder_of(tmp_path / "f", ["a.png", "b.png", "c.png"])
    poses = written(tmp_path / "p.txt", tum(1305031.0, HERE), tum(1305032.0, HERE))
    message = complaint(camera_of(str(tmp_path / "f"), poses=poses, loop=True).begin, "r", 0)
    assert "none of the 3 images" in message
    assert "a.png at 0.000 s to c.png at 0.200 s" in message
    assert "2 by time_s, 1305031.0 to 1305032.0" in message


def test_a_loop_begins_anew_with_the_same_images_and_poses(tmp_path):
    folder_of(tmp_path / "f", ["a.png", "b.png"])
    poses = written(tmp_path / "p.jsonl", line(HERE, index=0), line(THERE, index=1))
    camera = camera_of(str(tmp_path / "f"), poses=poses, loop=True)
    frames = [camera.begin("r", 0)[1].message, *(camera.next_frame()[0].message for _ in range(4))]
    assert [(f.step, int(f.rgb[0, 0, 0])) for f in frames] == [(0, 0), (1, 1), (2, 0), (3, 1), (4, 0)]
    np.testing.assert_allclose(frames[3].world_from_camera, THERE, atol=1e-12)


def test_an_endless_source_ends_with_its_poses(tmp_path):
    """A webcam gives images for ever: once the last pose is past none of them can be used."""
    class Endless:
        name, size_px, period_s, endless = "webcam:0", (480, 480), 0.1, True

        def __iter__(self):
            for k in range(1000):
                yield SourceImage(np.zeros((480, 480, 3), np.uint8), k, k / 10)
            raise AssertionError("still looking")

    poses = read_poses(written(tmp_path / "p.txt", tum(0.0, HERE), tum(0.32, HERE)))
    camera = Camera(Endless(), poses, VirtualCamera((480, 480)))
    assert len(frames_of(camera)) == 5  # at the last pose for a tenth of a second more


def test_what_is_assumed_is_said_and_what_is_known_is_not(tmp_path):
    folder_of(tmp_path / "f", ["a.png"], size=(640, 480))
    assumed = camera_of(str(tmp_path / "f")).notes
    assert ["intrinsics_px is not given" in assumed[0], "poses is not given" in assumed[1]] == [True, True]
    assert not any("\n" in note for note in assumed)
    known = {"intrinsics_px": [580, 580, 320, 240], "poses": written(tmp_path / "p.jsonl", line())}
    assert camera_of(str(tmp_path / "f"), **known).notes == ()
    narrow, = camera_of(str(tmp_path / "f"), **known | {"intrinsics_px": [900, 900, 320, 240]}).notes
    assert "covers 62% of the networks' field of view" in narrow


def test_frames_are_resampled_by_the_intrinsics_given(tmp_path):
    """The configuration reaches the images: a dot is where the training's camera would see it."""
    (tmp_path / "f").mkdir()
    drawn, _ = project(np.zeros(3), HERE, (400.0, 400.0, 320.0, 240.0))
    Image.fromarray(dots([drawn], (640, 480))).save(tmp_path / "f" / "a.png")
    poses = written(tmp_path / "p.jsonl", line())
    frame, = frames_of(camera_of(str(tmp_path / "f"), poses=poses, intrinsics_px=[400, 400, 320, 240]))
    expected, _ = project(np.zeros(3), frame.world_from_camera, frame.intrinsics_px)
    np.testing.assert_allclose(centroid(frame.rgb, expected), expected, atol=0.1)


def test_the_first_picture_of_a_folder_tells_its_focal_length(tmp_path):
    """Unless the user does."""
    (tmp_path / "f").mkdir()
    drawn, _ = project(np.zeros(3), HERE, (554.7, 554.7, 320.0, 240.0))
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 30
    Image.fromarray(dots([drawn], (640, 480))).save(tmp_path / "f" / "a.jpg", exif=exif, quality=95)
    poses = written(tmp_path / "p.jsonl", line())
    camera = camera_of(str(tmp_path / "f"), poses=poses)
    assert any("a.jpg: the focal length is from its EXIF data (30 mm in 35 mm film)" in note for note in camera.notes)
    frame, = frames_of(camera)
    expected, _ = project(np.zeros(3), frame.world_from_camera, frame.intrinsics_px)
    np.testing.assert_allclose(centroid(frame.rgb, expected), expected, atol=0.3)
    given = camera_of(str(tmp_path / "f"), poses=poses, intrinsics_px=[400, 400, 320, 240])
    assert not any("EXIF" in note for note in given.notes)


def test_a_goal_image_of_the_cameras_own_is_resampled_like_its_images(tmp_path):
    folder_of(tmp_path / "f", ["a.png"], size=(640, 480))
    pixels = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "goal.png")
    known = {"goal_image": tmp_path / "goal.png", "intrinsics_px": [500, 500, 320, 240]}
    goal = camera_of(str(tmp_path / "f"), **known).begin("r", 0)[0].message
    np.testing.assert_array_equal(goal.rgb, VirtualCamera((640, 480), (500, 500, 320, 240)).see(pixels))
    assert camera_of(str(tmp_path / "f"), **known, explore=True).goal_rgb is None


def test_a_goal_image_of_480_is_taken_as_it_is_and_one_of_another_size_by_its_own_intrinsics(tmp_path):
    folder_of(tmp_path / "f", ["a.png"], size=(640, 480))
    path = tmp_path / "goal.png"
    pixels = np.random.default_rng(0).integers(0, 255, (480, 480, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    np.testing.assert_array_equal(camera_of(str(tmp_path / "f"), goal_image=path).goal_rgb, pixels)
    for size, given in (((600, 480), None), ((640, 480), [700, 700, 320, 240])):
        Image.new("RGB", size, (9, 99, 200)).save(path)
        camera = camera_of(str(tmp_path / "f"), goal_image=path, goal_intrinsics_px=given)
        np.testing.assert_array_equal(camera.goal_rgb, read_goal_image(path, given).rgb)
        assert camera.notes[-1].startswith("goal image goal.png: the intrinsics are ")


@pytest.mark.parametrize(("key", "value"), [
    ("intrinsics_px", [1, 2, 3]), ("intrinsics_px", [0, 600, 320, 240]), ("rate_hz", 0), ("pose_convention", "maya"),
    ("sauce", "x")])
def test_a_bad_key_of_the_configuration_is_named(key, value):
    assert f"camera.{key}" in complaint(Config().with_values, {f"camera.{key}": value})


def test_without_a_source_it_says_what_to_give():
    assert "camera.source is not given: give a folder" in complaint(build, Config())


def test_services_elsewhere_find_the_same_files(tmp_path, monkeypatch):
    """Services may have another working directory than the user: paths become absolute, a webcam's name stays."""
    monkeypatch.chdir(tmp_path)
    config = resolve(Config().with_values({"camera.source": "images", "camera.poses": "p.txt"}))
    assert config.camera.source == str(tmp_path / "images")
    assert config.camera.poses == tmp_path / "p.txt"
    assert resolve(Config().with_values({"camera.source": "webcam:0"})).camera.source == "webcam:0"
