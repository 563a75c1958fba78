"""ROS 2 bags as the camera's source: what is taken of them, and what is said."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from saccade.app.run.run import resolve
from saccade.services.camera.ros.bag import open_bag_source
from saccade.services.camera.ros.storage import is_bag
from saccade.tests.fakes import ros
from saccade.tests.fakes.bags import camera_of, config_of, frames_of, grey, numbers
from saccade.tests.fakes.camera import HERE, THERE, complaint, folder_of, line, written
from saccade.tests.fakes.ros import FIRST_NS, IMAGE, INFO, OPTICAL, STEP_NS, TF, TF_STATIC, WORLD

STORAGES = ("mcap", "sqlite3")


@pytest.mark.parametrize("storage", STORAGES)
def test_the_images_of_a_bag_come_with_their_poses(tmp_path, storage):
    camera = camera_of(ros.bag(tmp_path / "b", ros.plain(5, HERE), storage=storage))
    frames = frames_of(camera)
    assert numbers(frames) == [0, 1, 2, 3, 4]
    for frame in frames:
        np.testing.assert_allclose(frame.world_from_camera, HERE, atol=1e-9)
    assert camera.period_s == pytest.approx(0.1)
    assert camera.skipped == 0
    assert camera.notes[0] == (
        "bag b: images /camera/image_raw (sensor_msgs/msg/Image), intrinsics /camera/camera_info, poses of "
        "camera_optical in world by world -> base -> camera_optical")
    assert camera.notes[1] == "intrinsics (61.00, 62.00, 32.00, 24.00) px are those of /camera/camera_info"


@pytest.mark.parametrize("storage", STORAGES)
def test_a_file_of_a_bag_is_one_too(tmp_path, storage):
    file, = (path for path in ros.bag(tmp_path / "b", ros.plain(2, HERE), storage=storage).iterdir()
             if path.suffix != ".yaml")
    assert numbers(frames_of(camera_of(file))) == [0, 1]
    (file.parent / "metadata.yaml").unlink()
    assert numbers(frames_of(camera_of(file.parent))) == [0, 1]
    assert resolve(config_of(str(file))).camera.source == str(file)


def test_with_loop_a_bag_begins_again(tmp_path):
    camera = camera_of(ros.bag(tmp_path / "b", ros.plain(2, HERE)), loop=True)
    camera.begin("r", 0)
    assert [int(np.median(camera.next_frame()[0].message.rgb)) for _ in range(4)] == [1, 0, 1, 0]


def test_messages_may_be_compressed_one_by_one(tmp_path):
    folder = ros.compressed_bag(tmp_path / "b", ros.plain(3, HERE), "MESSAGE")
    assert numbers(frames_of(camera_of(folder))) == [0, 1, 2]


def test_compressed_images_are_read(tmp_path):
    messages = ros.plain(3, HERE, image_of=ros.compressed, topic=f"{IMAGE}/compressed")
    camera = camera_of(ros.bag(tmp_path / "b", messages))
    assert numbers(frames_of(camera)) == [0, 1, 2]
    assert "images /camera/image_raw/compressed (sensor_msgs/msg/CompressedImage), intrinsics /camera/camera_info" \
        in camera.notes[0]


def moving(count, *, fixed_at=0):
    """The base moves along x by 10 cm in each period. Transforms are stamped between the images; the fixed transform is
    recorded after so many images."""
    for k in range(count):
        time_ns = FIRST_NS + k * STEP_NS
        yield IMAGE, time_ns, ros.image(time_ns, grey(k))
        if k == fixed_at:
            yield TF_STATIC, time_ns, ros.tf(time_ns, ("base", OPTICAL, ros.optical(HERE)))
        base = np.eye(4)
        base[0, 3] = 0.1 * (k - 0.5)
        stamp_ns = time_ns - STEP_NS // 2
        yield TF, time_ns, ros.tf(stamp_ns, (WORLD, "base", base))


def test_poses_are_those_at_the_images_stamps(tmp_path):
    """Transforms come later than the image that they are for, in the order of the recording."""
    camera = camera_of(ros.bag(tmp_path / "b", moving(6, fixed_at=3)), intrinsics_px=[61, 62, 32, 24])
    frames = frames_of(camera)
    assert numbers(frames) == [0, 1, 2, 3, 4, 5]
    for k, frame in zip((0, 1, 2, 3, 4, 4.5), frames, strict=True):  # the last transform is held for the last image
        np.testing.assert_allclose(frame.world_from_camera[:3, 3] - HERE[:3, 3], (0.1 * k, 0, 0), atol=1e-9)


def test_images_do_not_wait_for_ever(tmp_path):
    """Transforms end after two images. What comes later has no pose, is left out and counted."""
    def messages():
        for topic, time_ns, message in ros.plain(40, HERE):
            if topic != TF or time_ns < FIRST_NS + 2 * STEP_NS:
                yield topic, time_ns, message
    source = open_bag_source(ros.bag(tmp_path / "b", messages()), config_of("").camera)[0]
    poses = [image.world_from_camera is not None for image in source]
    assert poses == [True] * 3 + [False] * 37  # the last transform also holds for the image after it


def test_odometry_leads_from_where_tf_ends(tmp_path):
    def messages():
        yield TF_STATIC, FIRST_NS, ros.tf(FIRST_NS, ("base", OPTICAL, ros.optical(HERE)))
        for k in range(3):
            time_ns = FIRST_NS + k * STEP_NS
            yield "/odom", time_ns, ros.odometry(time_ns, np.eye(4))
            yield IMAGE, time_ns, ros.image(time_ns, grey(k))
    camera = camera_of(ros.bag(tmp_path / "b", messages()), intrinsics_px=[61, 62, 32, 24])
    np.testing.assert_allclose(frames_of(camera)[2].world_from_camera, HERE, atol=1e-9)
    assert "poses of camera_optical in odom by odom -> base -> camera_optical and /odom" in camera.notes[0]


def test_a_stamped_pose_is_that_of_the_camera(tmp_path):
    def messages(topics=("/mocap",)):
        for k in range(3):
            time_ns = FIRST_NS + k * STEP_NS
            for topic in topics:
                yield topic, time_ns, ros.pose_stamped(time_ns, ros.optical(THERE))
            yield IMAGE, time_ns, ros.image(time_ns, grey(k))
    px = {"intrinsics_px": [61, 62, 32, 24]}
    camera = camera_of(ros.bag(tmp_path / "b", messages()), **px)
    np.testing.assert_allclose(frames_of(camera)[2].world_from_camera, THERE, atol=1e-9)
    two = ros.bag(tmp_path / "two", messages(("/mocap", "/other")))
    assert "poses of several topics, /mocap, /other: give camera.pose_topic" in complaint(camera_of, two, **px)
    assert "and /other" in camera_of(two, pose_topic="/other", **px).notes[0]
    said = complaint(camera_of, two, pose_topic="/none")
    assert "has no poses /none: camera.pose_topic can be /mocap, /other" in said


def test_poses_of_a_file_are_taken_instead(tmp_path):
    """Their times since 1970 are those of the images' stamps."""
    poses = written(tmp_path / "p.jsonl", line(THERE))
    messages = [m for m in ros.plain(2, HERE) if m[0] in (IMAGE, INFO)]
    camera = camera_of(ros.bag(tmp_path / "b", messages), poses=poses)
    np.testing.assert_allclose(frames_of(camera)[1].world_from_camera, THERE, atol=1e-9)
    assert "those of /camera/camera_info" in " ".join(camera.notes)
    tum = written(tmp_path / "p.txt", *(f"{(FIRST_NS + k * STEP_NS) / 1e9:.6f} {k} 0 1 1 0 0 0" for k in (0, 1)))
    frames = frames_of(camera_of(tmp_path / "b", poses=tum))
    assert [round(frame.world_from_camera[0, 3], 5) for frame in frames] == [0, 1]


def test_frames_can_be_asked_for(tmp_path):
    messages = [*ros.plain(2, HERE), (TF_STATIC, FIRST_NS, ros.tf(FIRST_NS, ("map", WORLD, np.eye(4))))]
    folder = ros.bag(tmp_path / "b", messages)
    assert "in map by map -> world -> base -> camera_optical" in camera_of(folder).notes[0]
    camera = camera_of(folder, world_frame="/world", camera_frame="base")
    assert "poses of base in world by world -> base" in camera.notes[0]
    np.testing.assert_allclose(frames_of(camera)[0].world_from_camera, np.diag([1, -1, -1, 1]), atol=1e-9)


def two_topics(first_info=True, second_info=False):
    for topic, time_ns, message in ros.plain(2, HERE):
        if topic == IMAGE:
            yield "/depth/image", time_ns, message
        if topic != INFO or first_info:
            yield topic, time_ns, message
        if topic == INFO and second_info:
            yield "/depth/camera_info", time_ns, message


def test_of_two_topics_the_one_with_a_camera_info_is_taken(tmp_path):
    assert "images /camera/image_raw" in camera_of(ros.bag(tmp_path / "b", two_topics())).notes[0]
    assert "images /depth/image" in camera_of(tmp_path / "b", image_topic="/depth/image").notes[0]
    said = complaint(camera_of, tmp_path / "b", image_topic="/none")
    assert "has no images /none: camera.image_topic can be /camera/image_raw, /depth/image" in said
    both = "has images of several topics, /camera/image_raw, /depth/image, and "
    assert both + "more than one has a CameraInfo: give --image-topic" in complaint(
        camera_of, ros.bag(tmp_path / "both", two_topics(second_info=True)))
    assert both + "none has a CameraInfo: give --image-topic" in complaint(
        camera_of, ros.bag(tmp_path / "none", two_topics(first_info=False)))


def test_depth_images_are_no_images(tmp_path):
    """So the colour images of a depth camera are found."""
    def messages():
        for topic, time_ns, message in two_topics(second_info=True):
            if topic == "/depth/image":
                message = ros.image(time_ns, np.zeros((4, 4, 2), np.uint8), "16UC1")
            yield topic, time_ns, message
    assert "images /camera/image_raw" in camera_of(ros.bag(tmp_path / "b", messages())).notes[0]
    assert "no image of /depth/image can be decoded: the encoding '16UC1' is not known" in complaint(
        camera_of, tmp_path / "b", image_topic="/depth/image")


def test_a_folder_of_images_is_no_bag(tmp_path):
    assert not is_bag(folder_of(tmp_path / "f", ["a.png"]))
    assert not is_bag(tmp_path / "nowhere")
    shutil.copy(ros.bag(tmp_path / "b", ros.plain(1, HERE)) / "b.mcap", tmp_path / "f" / "x.mcap")
    assert is_bag(tmp_path / "f")
