"""Messages of ROS: their pixels, transforms and calibrations, whole or damaged."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from saccade.services.camera.ros.calibration import base_of, info_topic, is_rectified, lens_of
from saccade.services.camera.ros.pixels import rgb_of
from saccade.services.camera.ros.transforms import HELD_NS, MOST_FRAMES, TransformTree
from saccade.shared.ros import types
from saccade.shared.ros.types import COMPRESSED, IMAGE, RosError, decode
from saccade.tests.fakes import ros

COLOUR = (200, 120, 40)
SECOND = 1_000_000_000
STILL = (0.0, 0.0, 0.0, 1.0)


def through(message):
    """The message as it is read: encoded by rosbags, decoded by Saccade."""
    return decode(message.__msgtype__, ros.cdr(message))


def mosaic(pattern, height=8, width=10):
    """What a sensor with this pattern, such as `rggb`, sees of COLOUR."""
    tile = np.array([COLOUR["rgb".index(letter)] for letter in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (height // 2, width // 2))[..., None]


def yuv(order, height=4, width=6):
    """COLOUR in two bytes per pixel, by the definition of ITU-R BT.601."""
    r, g, b = (x / 255 for x in COLOUR)
    luma = 0.299 * r + 0.587 * g + 0.114 * b
    values = {"y": 16 + 219 * luma, "u": 128 + 224 * (b - luma) / 1.772, "v": 128 + 224 * (r - luma) / 1.402}
    pair = np.array([values[letter] for letter in order]).round().astype(np.uint8).reshape(2, 2)
    return np.tile(pair, (height, width // 2, 1))


def channels(*order):
    rng = np.random.default_rng(0)
    rgba = np.concatenate([rng.integers(0, 256, (5, 7, 3), np.uint8), np.full((5, 7, 1), 9, np.uint8)], axis=2)
    return rgba[..., list(order)], rgba[..., :3]


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("8UC3", (2, 1, 0)),
                                                  ("rgba8", (0, 1, 2, 3)), ("bgra8", (2, 1, 0, 3))])
def test_channels_come_in_the_order_of_rgb(encoding, order):
    pixels, rgb = channels(*order)
    np.testing.assert_array_equal(rgb_of(IMAGE, through(ros.image(0, pixels, encoding))), rgb)


def test_rows_may_be_padded():
    rgb = channels(0, 1, 2)[1]
    padded = np.zeros((5, 10, 3), np.uint8)
    padded[:, :7] = rgb
    message = ros.image(0, padded)
    message.width = 7
    np.testing.assert_array_equal(rgb_of(IMAGE, through(message)), rgb)


@pytest.mark.parametrize(("encoding", "pixels"), [
    *((f"bayer_{pattern}8", mosaic(pattern)) for pattern in ("rggb", "bggr", "gbrg", "grbg")),
    ("yuyv", yuv("yuyv")), ("yuv422_yuy2", yuv("yuyv")), ("uyvy", yuv("uyvy")), ("yuv422", yuv("uyvy"))])
def test_colours_are_made_of_patterns_and_yuv(encoding, pixels):
    rgb = rgb_of(IMAGE, through(ros.image(0, pixels, encoding)))
    assert rgb.shape == (*pixels.shape[:2], 3)
    np.testing.assert_allclose(rgb.reshape(-1, 3).astype(int), np.tile(COLOUR, (rgb[..., 0].size, 1)), atol=2)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_is_the_same_in_all_channels(encoding):
    grey = np.arange(35, dtype=np.uint8).reshape(5, 7, 1)
    np.testing.assert_array_equal(rgb_of(IMAGE, through(ros.image(0, grey, encoding))), np.repeat(grey, 3, axis=2))


def test_compressed_images_are_opened():
    rgb = np.full((20, 30, 3), COLOUR, np.uint8)
    np.testing.assert_array_equal(rgb_of(COMPRESSED, through(ros.compressed(0, rgb, "PNG"))), rgb)
    assert np.abs(rgb_of(COMPRESSED, through(ros.compressed(0, rgb, "JPEG"))).astype(int) - rgb).max() <= 3
    assert rgb_of(COMPRESSED, through(ros.compressed(0, rgb[..., 0], "JPEG"))).shape == (20, 30, 3)


@pytest.mark.parametrize(("change", "words"), [
    ({"encoding": "16UC1"}, "the encoding '16UC1' is not known; known are rgb8"),
    ({"height": 6}, "105 bytes in rows of 21 are no 7x6 pixels of rgb8"),
    ({"step": 20}, "are no 7x5 pixels"), ({"width": 0}, "no image has 0x5 pixels"),
    ({"width": 2 ** 31, "height": 2 ** 31, "step": 2 ** 32 - 1}, "no image has 2147483648x2147483648 pixels")])
def test_images_that_are_none_are_refused(change, words):
    message = ros.image(0, channels(0, 1, 2)[1])
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(RosError, match=words):
        rgb_of(IMAGE, through(message))


def test_compressed_images_that_are_none_are_refused():
    message = ros.compressed(0, np.zeros((20, 30, 3), np.uint8))
    for data in (message.data[:len(message.data) // 2], np.frombuffer(b"\0\0\0\0PNG depth", np.uint8)):
        message.data = data
        with pytest.raises(RosError, match="no whole JPEG or PNG"):
            rgb_of(COMPRESSED, through(message))


def test_every_cut_message_is_refused():
    """Wherever it is cut, and not by another exception."""
    for message in (ros.tf(0, ("a", "b", np.eye(4)), ("b", "c", np.eye(4))), ros.info(0, d=(0.1,) * 5),
                    ros.image(0, np.zeros((2, 2, 3), np.uint8)), ros.odometry(0, np.eye(4))):
        data = ros.cdr(message)
        for length in range(len(data) - 4):
            with pytest.raises(RosError):
                decode(message.__msgtype__, data[:length])
    with pytest.raises(RosError, match="does not begin like a message in CDR"):
        decode(IMAGE, b"\x01\x02\x03\x04")


def test_what_a_damaged_message_claims_is_not_allocated():
    data = bytearray(ros.cdr(ros.tf(0, ("a", "b", np.eye(4)))))
    data[4:8] = b"\xff\xff\xff\x7f"  # so many transforms
    with pytest.raises(RosError):
        decode(types.TF, bytes(data))


def test_types_have_the_hashes_that_ros_tells():
    """As `ros2 topic info --verbose` prints them in ROS 2 Jazzy. Nodes hear a topic only under the right hash."""
    assert types.hash_of(IMAGE) == "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert types.hash_of(types.MARKERS) == "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"


def tree_of(*links, fixed=False):
    tree = TransformTree()
    for parent, child, time_ns, position in links:
        tree.add(parent, child, time_ns, position, STILL, fixed=fixed)
    return tree


def test_poses_between_two_stamps_are_interpolated():
    turns = Rotation.from_euler("xyz", [[0.1, 0.2, 0.3], [-0.8, 0.4, 1.9]])
    tree = TransformTree()
    for time_ns, x, turn in ((0, 0.0, turns[0]), (SECOND, 1.0, turns[1])):
        sign = -1 if time_ns else 1  # a quaternion and its negative are the same rotation
        tree.add("world", "camera", time_ns, (x, 2 * x, 0.0), sign * turn.as_quat())
    pose = tree.at("world", "camera", SECOND // 4)
    np.testing.assert_allclose(pose[:3, 3], (0.25, 0.5, 0.0), atol=1e-9)
    np.testing.assert_allclose(pose[:3, :3], Slerp([0, 1], turns)(0.25).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.at("camera", "world", SECOND // 4), np.linalg.inv(pose), atol=1e-9)


def test_the_world_need_not_be_above_the_camera():
    tree = tree_of(("map", "odom", 0, (1, 0, 0)), ("odom", "camera", 0, (0, 1, 0)), ("map", "table", 0, (0, 0, 1)))
    assert tree.path("table", "camera") == ["table", "map", "odom", "camera"]
    np.testing.assert_allclose(tree.at("table", "camera", 0)[:3, 3], (1, 1, -1))
    assert tree.path("table", "elsewhere") is None


def test_no_pose_is_made_up():
    """Not across a long gap, and not long before the first or after the last transform."""
    tree = tree_of(("w", "c", 0, (0, 0, 0)), ("w", "c", SECOND, (1, 0, 0)), ("w", "c", 4 * SECOND, (2, 0, 0)))
    found = [tree.at("w", "c", int(at * SECOND)) is not None for at in (-0.2, -0.05, 0.5, 1.05, 2.5, 3.95, 4.05, 4.2)]
    assert found == [False, True, True, True, False, True, True, False]
    assert tree_of(("w", "c", 0, (0, 0, 0)), fixed=True).at("w", "c", 99 * SECOND) is not None


def test_it_is_known_whether_waiting_helps():
    tree = tree_of(("w", "b", 5, (0, 0, 0)), ("b", "c", 3, (0, 0, 0)))
    assert tree.reaches("w", "c", 3)
    assert not tree.reaches("w", "c", 4)
    assert not tree.reaches("w", "elsewhere", 0)


def test_the_past_is_bounded():
    tree = TransformTree()
    for k in range(5000):
        tree.add("w", "c", k * SECOND // 50, (k, 0, 0), STILL)
    link = tree._links["c"]
    assert len(link.times_ns) == len(link.values) <= 2 * 50 * (HELD_NS // SECOND) + 1
    assert link.times_ns[-1] - link.times_ns[0] >= HELD_NS
    tree.add("w", "c", 0, (7, 0, 0), STILL)  # a simulation that begins anew
    assert link.times_ns == [0]


def test_frames_are_bounded_and_circles_end():
    tree = tree_of(*(("w", f"f{k}", 0, (0, 0, 0)) for k in range(MOST_FRAMES)))
    with pytest.raises(RosError, match="more than 10000 frames"):
        tree.add("w", "one_more", 0, (0, 0, 0), STILL)
    tree = tree_of(("a", "b", 0, (0, 0, 0)), ("b", "c", 0, (0, 0, 0)), ("c", "a", 0, (0, 0, 0)))
    assert tree.up("c") == ["c", "b", "a"]
    assert tree.at("w", "c", 0) is None


@pytest.mark.parametrize(("position", "quaternion", "words"), [
    ((np.nan, 0, 0), STILL, "not finite"), ((1e9, 0, 0), STILL, "not finite"),
    ((0, 0, 0), (0, 0, 0, 0), "has length 0.000, not 1")])
def test_transforms_that_cannot_be_are_refused(position, quaternion, words):
    with pytest.raises(RosError, match=words):
        TransformTree().add("w", "c", 0, position, quaternion)


def test_a_lens_is_counted_from_the_corner_of_the_first_pixel():
    lens = lens_of(through(ros.info(0, d=(0.1, 0.2, 0.3, 0.4, 0.5))), rectified=False)
    assert lens.intrinsics_px == (61.0, 62.0, 32.0, 24.0)
    assert lens.size_px == ros.SIZE
    assert dict(lens.distortion) == {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}


def test_rectified_images_have_the_projection_and_no_distortion():
    lens = lens_of(ros.info(0, d=(0.1, 0.2, 0, 0), p=(50.0, 51.0, 30.5, 22.5)), rectified=True)
    assert lens.intrinsics_px == (50.0, 51.0, 31.0, 23.0)
    assert not lens.distorts


def test_fisheye_and_regions_of_interest():
    lens = lens_of(ros.info(0, d=(0.1, 0.2, 0.3, 0.4), model="equidistant", roi=(10, 4, 32, 40)), rectified=False)
    assert lens.fisheye
    assert (lens.intrinsics_px, lens.size_px) == ((61.0, 62.0, 22.0, 20.0), (32, 40))


@pytest.mark.parametrize(("more", "words"), [
    ({"k": (0.0, 0.0, 0.0, 0.0)}, "not calibrated"), ({"d": (0.1,) * 4, "model": "own"}, "'own' are not known"),
    ({"d": (0.1, 0.2)}, "2 coefficients"), ({"k": (np.nan, 1.0, 1.0, 1.0)}, "not finite")])
def test_calibrations_that_cannot_be_are_refused(more, words):
    with pytest.raises(RosError, match=words):
        lens_of(ros.info(0, **more), rectified=False)


def test_a_camera_info_is_found_by_its_name():
    infos = {"/a/camera_info", "/b/image_raw/camera_info"}
    assert [info_topic(topic, infos) for topic in ("/a/image_raw", "/a/image_raw/compressed", "/b/image_raw", "/c/x")] \
        == ["/a/camera_info", "/a/camera_info", "/b/image_raw/camera_info", None]
    assert base_of("/a/image_rect/compressed") == "/a/image_rect"
    assert is_rectified("/a/image_rect_color/compressed")
    assert not is_rectified("/direct/image_raw")
