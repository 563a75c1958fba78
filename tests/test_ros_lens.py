"""A ROS 2 bag together with boards and calibrations: who tells the lens and the poses, and what is removed."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2")

from saccade.app.run.run import in_world
from saccade.services.camera.calibration import Calibration
from saccade.services.camera.virtual_camera import FILL
from saccade.shared.world.geometry import INTRINSICS_PX, project
from saccade.tests.fakes import ros
from saccade.tests.fakes.bags import camera_of, config_of, frames_of
from saccade.tests.fakes.board import PINHOLE, SHEET, SIZE, seen, view
from saccade.tests.fakes.camera import HERE, centroid, complaint, dots, line, written
from saccade.tests.fakes.ros import FIRST_NS, IMAGE, INFO, STEP_NS, TF

D = tuple(value for _, value in PINHOLE.distortion)  # k1, k2, p1, p2, k3
FX, FY, CX, CY = PINHOLE.intrinsics_px
POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.08, 0.0], [-0.11, 0.06, 0.1], [0.04, -0.13, 0.05]])
VIEWS = (view(20, 50), view(22, 51))


def bag(folder, images, *, d=D, infos=True):
    """The images of the lens PINHOLE, with its CameraInfo and without tf."""
    def messages():
        for k, rgb in enumerate(images):
            time_ns = FIRST_NS + k * STEP_NS
            if infos:
                yield INFO, time_ns, ros.info(time_ns, SIZE, (FX, FY, CX - 0.5, CY - 0.5), d)
            yield IMAGE, time_ns, ros.image(time_ns, rgb)
    return ros.bag(folder, messages())


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A bag of a board, in two images, and the board's description."""
    folder = tmp_path_factory.mktemp("board")
    (folder / "board.json").write_text(SHEET.model_dump_json())
    bag(folder / "bag", [seen(VIEWS[0]), seen(VIEWS[1])])
    return folder


def test_the_distortion_of_a_camera_info_is_removed(tmp_path):
    """Points are drawn where the lens shows them, and come to lie where the training's camera sees them."""
    local = (POINTS - HERE[:3, 3]) @ HERE[:3, :3]
    image = dots(PINHOLE.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:]), SIZE)
    camera = camera_of(bag(tmp_path / "b", [image]), poses=written(tmp_path / "still.jsonl", line(HERE)))
    rgb = frames_of(camera)[0].rgb
    expected, _ = project(POINTS, HERE, INTRINSICS_PX)
    np.testing.assert_allclose([centroid(np.where(rgb == FILL, 0, rgb), near) for near in expected], expected,
                               atol=0.3)
    assert "intrinsics (610.00, 612.00, 325.00, 236.00) px are those of /camera/camera_info" in camera.notes
    assert any(note.startswith("the distortion of the lens (k1 -0.21, ") and note.endswith(", is removed")
               for note in camera.notes)


def test_a_bag_with_a_board_needs_no_tf(board):
    """Its CameraInfo tells the board the lens. A tf that is there would not be read."""
    camera = camera_of(board / "bag", board=board / "board.json")
    for frame, true in zip(frames_of(camera), VIEWS, strict=True):
        np.testing.assert_allclose(frame.world_from_camera, true, atol=0.006)
    assert camera.notes[0] == f"bag bag: images {IMAGE} (sensor_msgs/msg/Image), intrinsics {INFO}"
    assert not any("stand still" in note for note in camera.notes)
    assert not camera.source._choice.wants(TF)


def test_a_calibration_takes_the_place_of_a_camera_info(board, tmp_path):
    """One that no camera can have is not even looked at."""
    Calibration(size_px=SIZE, intrinsics_px=PINHOLE.intrinsics_px, distortion=D).write(tmp_path / "c.toml")
    broken = bag(tmp_path / "b", [seen(VIEWS[0])], d=(np.nan,) * 5)
    assert "give --intrinsics or --calibration" in complaint(camera_of, broken, board=board / "board.json")
    camera = camera_of(broken, board=board / "board.json", calibration=str(tmp_path / "c.toml"))
    np.testing.assert_allclose(frames_of(camera)[0].world_from_camera, VIEWS[0], atol=0.006)
    assert camera.notes[0].endswith(", no CameraInfo used")
    assert "px are those of the calibration" in camera.notes[1]


def test_a_board_without_any_intrinsics_is_refused(board, tmp_path):
    none = bag(tmp_path / "b", [np.zeros((SIZE[1], SIZE[0], 3), np.uint8)], infos=False)
    said = complaint(in_world, config_of(str(none), board=board / "board.json"), "camera")
    assert said.startswith("camera.board needs the camera's intrinsics: calibrate it")
