"""ROS 2 bags that are damaged, lack something, or are none."""

from __future__ import annotations

import builtins
import sqlite3

import numpy as np
import pytest

from saccade.shared.log.recording import RunLog
from saccade.shared.ros import types
from saccade.tests.fakes import ros
from saccade.tests.fakes.bags import camera_of, frames_of, grey, numbers
from saccade.tests.fakes.camera import HERE, complaint
from saccade.tests.fakes.ros import FIRST_NS, IMAGE, INFO, SIZE, TF, WORLD


def test_messages_that_cannot_be_decoded_are_counted_and_left_out(tmp_path, capsys):
    def messages():
        for k, (topic, time_ns, message) in enumerate(ros.plain(5, HERE)):
            if topic == IMAGE and k == 6:
                message = (message.__msgtype__, ros.cdr(message)[:500])
            if topic == IMAGE and k == 9:
                message = ros.image(time_ns, np.zeros((4, 4, 3), np.uint8))
            if topic == TF and k == 7:
                message = ros.tf(time_ns, (WORLD, "base", np.eye(4)))
                message.transforms[0].transform.rotation.w = np.nan
            yield topic, time_ns, message
    camera = camera_of(ros.bag(tmp_path / "b", messages()))
    assert numbers(frames_of(camera)) == [0, 3, 4]
    assert (camera.refused, camera.skipped) == (3, 0)
    said = capsys.readouterr().err.splitlines()
    assert [text.partition(": a message is left out: ")[2][:40] for text in said] == [
        "/camera/image_raw: it is cut or damaged ", "/tf: the transform from base to world is"]


def test_a_bag_that_is_cut_is_read_up_to_there(tmp_path, capsys):
    def messages():
        rng = np.random.default_rng(0)
        for topic, time_ns, message in ros.plain(200, HERE):
            if topic == IMAGE:  # the bag gets several chunks
                message = ros.image(time_ns, rng.integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8))
            yield topic, time_ns, message
    file, = ros.bag(tmp_path / "b", messages()).glob("*.mcap")
    data = file.read_bytes()
    file.write_bytes(data[:len(data) * 3 // 4])
    frames = frames_of(camera_of(file))
    assert 50 < len(frames) < 200
    assert "b.mcap is cut or damaged" in capsys.readouterr().err
    file.write_bytes(data[:3000])
    assert "cannot be read: b.mcap is cut or damaged" in complaint(camera_of, file)


@pytest.mark.parametrize(("messages", "words"), [
    ([("/tf", FIRST_NS, ros.tf(FIRST_NS, ("a", "b", np.eye(4))))],
     "has no images: record a topic of sensor_msgs/Image or CompressedImage"),
    ([(IMAGE, FIRST_NS, ros.image(FIRST_NS, np.zeros((4, 4, 2), np.uint8), "16UC1"))],
     "no image of /camera/image_raw can be decoded: the encoding '16UC1' is not known"),
    ([(IMAGE, FIRST_NS, ros.image(FIRST_NS, grey(1)))],
     "no transform leads from the camera's frame camera_optical to the world: give --camera-frame and --world-frame"),
    ([(IMAGE, FIRST_NS, ros.image(FIRST_NS, grey(1), frame=""))], "name no frame: give --camera-frame"),
    ([(IMAGE, FIRST_NS, ros.image(FIRST_NS, grey(1))), (INFO, FIRST_NS, ros.info(FIRST_NS, k=(0, 0, 0, 0)))],
     "/camera/camera_info: the camera is not calibrated")])
def test_bags_that_are_not_enough_are_refused(tmp_path, messages, words):
    assert words in complaint(camera_of, ros.bag(tmp_path / "b", messages))


def test_a_world_that_is_not_connected_is_named(tmp_path):
    folder = ros.bag(tmp_path / "b", ros.plain(2, HERE))
    said = complaint(camera_of, folder, world_frame="moon")
    assert "from the camera's frame camera_optical to the world (moon); from camera_optical they lead to world" in said
    assert "from the camera's frame eye to the world" in complaint(camera_of, folder, camera_frame="eye")


def test_other_files_are_refused(tmp_path):
    log = RunLog(tmp_path / "run.mcap", world="table", configuration="{}")
    log.close()
    assert "is a log of Saccade" in complaint(camera_of, tmp_path / "run.mcap")
    for name, data, words in (("a.mcap", b"no", "is not an MCAP file"), ("b.mcap", b"", "is empty"),
                              ("a.db3", b"no", "is not an SQLite file"), ("a.bag", b"", "is a bag of ROS 1: convert"),
                              ("a.db3.zstd", b"", "decompress it with `zstd -d"),
                              ("c.mcap", b"\x89MCAP0\r\n", "too damaged to be read")):
        (tmp_path / name).write_bytes(data)
        assert words in complaint(camera_of, tmp_path / name)
    with sqlite3.connect(tmp_path / "b.db3") as connection:
        connection.execute("CREATE VIEW topics AS SELECT 1")
    assert "without messages of ROS 2" in complaint(camera_of, tmp_path / "b.db3")


@pytest.mark.parametrize(("change", "words"), [
    (lambda text: text.replace("compression_mode: ''", "compression_mode: 'message'")
     .replace("compression_format: ''", "compression_format: 'lz4'"), "compressed by 'lz4', which is not known"),
    (lambda text: text.replace("b.mcap", "c.mcap"), "lacks the file c.mcap"),
    (lambda text: text.replace("relative_file_paths", "paths"), "does not name the files"),
    (lambda text: text[:20] + "[", "is not one of rosbag2")])
def test_a_description_that_does_not_fit_is_refused(tmp_path, change, words):
    path = ros.bag(tmp_path / "b", ros.plain(1, HERE)) / "metadata.yaml"
    path.write_text(change(path.read_text()))
    assert words in complaint(camera_of, tmp_path / "b")


def test_a_compression_that_is_not_known_is_named(tmp_path):
    folder = tmp_path / "b"
    with ros.Writer(folder, version=9, storage_plugin=ros.StoragePlugin.MCAP) as writer:
        ros.write(writer, ros.plain(2, HERE))
    path, = folder.glob("*.mcap")
    data = path.read_bytes()
    at = data.index(b"\x06", 20) + 9 + 28  # the length of the first chunk's compression, which is ""
    assert data[at:at + 4] == bytes(4)
    path.write_bytes(data[:at] + b"\x02\0\0\0xz" + data[at + 4:])
    assert "cannot be read" in complaint(camera_of, path)


def test_without_rosbags_it_is_said(tmp_path, monkeypatch):
    real = builtins.__import__
    types._types.cache_clear()
    folder = ros.bag(tmp_path / "b", ros.plain(1, HERE))
    monkeypatch.setattr(builtins, "__import__", lambda name, *more, **others: (_ for _ in ()).throw(
        ImportError(name)) if name.startswith("rosbags") else real(name, *more, **others))
    assert "pip install 'saccade[ros]'" in complaint(camera_of, folder)
