"""A printed board: its sheet has the exact size, and an image of it gives the right pose or none."""

from __future__ import annotations

import json
import re
import sys
import zlib

import numpy as np
import pytest
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from saccade.app.camera.sheet import PAPERS, board_for, pdf_of
from saccade.services.camera import board_pose
from saccade.services.camera.board_pose import Doubtful, Measured, measure
from saccade.services.camera.charuco import Board, Corners, Finder, black_boxes_m, read_board
from saccade.services.camera.core import build
from saccade.services.camera.pose_filter import RETURNS, PoseFilter
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.config import Config
from saccade.shared.world.geometry import look_at, pose, project, rotation_angle
from saccade.tests.fakes.board import FISHEYE, PINHOLE, SHEET, SIZE, seen, view
from saccade.tests.fakes.camera import line, written
from saccade.tests.front_door import call
from saccade.tests.hostile import complaint

cv2 = pytest.importorskip("cv2")
POINTS_PER_M = 72 / 0.0254
FREE = Board(squares=(7, 10), square_m=0.025, marker_m=0.019, free_middle=True)


def apart(found, true) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    return (float(np.linalg.norm(found[:3, 3] - true[:3, 3])),
            float(np.degrees(rotation_angle(found[:3, :3], true[:3, :3]))))


def posed(rgb, camera=PINHOLE, board=SHEET):
    return measure(board, Finder(board).find(rgb), camera)


# The sheet.

@pytest.mark.parametrize(("paper", "points"), [("a4", (595.276, 841.89)), ("letter", (612, 792)),
                                               ("a3", (841.89, 1190.551))])
def test_the_pdf_has_the_exact_size(paper, points):
    """The page, every black box and the ruler, read from the PDF's own drawing commands in points of 1/72 inch."""
    board = board_for(PAPERS[paper], None, free_middle=False)
    pdf = pdf_of(board, PAPERS[paper], "board.json")
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", pdf)
    np.testing.assert_allclose([float(box[1]), float(box[2])], points, atol=0.01)
    streams = [zlib.decompress(part) for part in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
               if part[:1] == b"x"]
    drawing = next(stream for stream in streams if stream.count(b" l\n") > 500).decode("latin-1")
    paths = [np.array(re.findall(r"([-\d.]+) ([-\d.]+) [ml]\b", path), dtype=float)
             for path in re.findall(r"[-\d.]+ [-\d.]+ m\n(?:[-\d.]+ [-\d.]+ l\n)+", drawing)]
    boxes = np.array([[*path.min(0), *path.max(0)] for path in paths if len(path) >= 4 and np.ptp(path, axis=0).all()])
    expected = black_boxes_m(board) * POINTS_PER_M
    boxes = boxes[-len(expected):] if len(boxes) > len(expected) else boxes  # the page's own background comes first
    np.testing.assert_allclose(boxes - boxes[0, [0, 1, 0, 1]], expected - expected[0, [0, 1, 0, 1]], atol=0.01)
    ruler = max((path for path in paths if len(path) == 2), key=lambda path: np.ptp(path[:, 0]))
    assert np.ptp(ruler[:, 0]) == pytest.approx(PAPERS[paper].ruler_m * POINTS_PER_M, abs=0.01)


def test_the_command_writes_a_sheet_and_its_description(monkeypatch, capsys, tmp_path):
    code, out, _ = call(monkeypatch, capsys, "board", "--out", tmp_path / "b.pdf", "--middle", "free")
    assert code == 0
    assert "measure the ruler: 150 mm" in out
    board = read_board(tmp_path / "b.json")
    assert (board.square_m, board.free_middle, board.squares) == (0.025, True, (7, 10))
    call(monkeypatch, capsys, "board", "--out", tmp_path / "b.pdf", "--measured-mm", "147")
    assert read_board(tmp_path / "b.json").square_m == pytest.approx(0.025 * 147 / 150)
    for options, words in ((("--measured-mm", "15"), "measure it again, in millimetres"),
                           (("--square-mm", "90"), "give smaller squares"), (("--out", "b.png"), "end in .pdf")):
        code, _, err = call(monkeypatch, capsys, "board", "--out", tmp_path / "c.pdf", *options)
        assert (code, err.count("\n")) == (2, 1)
        assert words in err
    assert not (tmp_path / "c.pdf").exists()


@pytest.mark.parametrize(("text", "words"), [
    ("", "is not JSON of a board"), ("[1, 2]", "it holds no map of keys"), ("{", "is not JSON"),
    ('{"squares": [7, 10]}', "square_m"), ('{"squares": [7, 10], "square_m": 25, "marker_m": 19}', "square_m"),
    ('{"squares": [7, 10], "square_m": 0.025, "marker_m": 0.03}', "marker_m 0.03 is not between"),
    ('{"squares": [60, 60], "square_m": 0.025, "marker_m": 0.019}', "need 1800 markers"),
    ('{"squares": [7, 10], "square_m": 0.025, "marker_m": 0.019, "colour": 1}', "there is no such key"),
    ('{"squares": [1e99, 10], "square_m": 0.025, "marker_m": 0.019}', "whole number"),
    ('{"squares": [4, 4], "square_m": 0.025, "marker_m": 0.019, "free_middle": true}', "no room for a free middle")])
def test_a_damaged_description_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "b.json"
    path.write_text(text)
    message = complaint(read_board, path)
    assert message.startswith(f"board {path}")
    assert words in message


def test_without_opencv_it_says_so(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "cv2", None)
    code, _, err = call(monkeypatch, capsys, "board", "--out", tmp_path / "b.pdf")
    assert (code, err.count("\n")) == (2, 1)
    assert "boards need OpenCV" in err
    assert "pip install 'saccade[camera]'" in err


# The pose of one image.

@pytest.mark.parametrize(("where", "camera"), [
    ((20, 50, 0.5, 10), PINHOLE), ((200, 28, 0.5), PINHOLE), ((100, 80, 0.5, 180), PINHOLE), ((300, 60, 0.3), FISHEYE)])
def test_a_board_gives_the_pose_of_the_camera(where, camera):
    true = view(*where)
    found = posed(seen(true, camera), camera)
    assert isinstance(found, Measured)
    metres, degrees = apart(found.world_from_camera, true)
    assert metres < 0.003
    assert degrees < 0.3
    assert np.sqrt(np.diag(found.covariance)).max() < 0.02


def test_a_free_middle_leaves_enough_corners():
    true = view(40, 55, 0.4)
    rgb = seen(true, board=FREE)
    assert (Finder(FREE).find(rgb).ids.size, FREE.usable.sum()) == (26, 26)
    assert apart(posed(rgb, board=FREE).world_from_camera, true)[0] < 0.003


def hard_cases():
    cut = seen(view(30, 50, 0.5))
    cut[:, 330:] = 140
    yield "cut off", view(30, 50, 0.5), cut
    yield "steep", view(80, 8, 0.5), seen(view(80, 8, 0.5))
    yield "nearly straight on, far away", view(0, 88, 0.9), seen(view(0, 88, 0.9))
    for sigma in (1.5, 3.0, 6.0):
        sharp = Image.fromarray(seen(view(10, 45, 0.5)))
        yield f"blurred by {sigma}", view(10, 45, 0.5), np.asarray(sharp.filter(ImageFilter.GaussianBlur(sigma)))
    rng = np.random.default_rng(0)
    yield "noise alone", view(10, 45, 0.5), rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    half = seen(view(10, 45, 0.5))
    half[220:260] = 20  # something lies across it
    yield "covered", view(10, 45, 0.5), half


def test_a_bad_image_gives_a_right_pose_or_none():
    outcomes = {}
    for name, true, rgb in hard_cases():
        found = posed(np.ascontiguousarray(rgb))
        if isinstance(found, Measured):
            assert apart(found.world_from_camera, true)[0] < 0.02, name
        outcomes[name] = isinstance(found, Measured)
    assert outcomes["cut off"]
    assert outcomes["covered"]
    assert outcomes["blurred by 1.5"]
    assert not outcomes["noise alone"]
    assert not outcomes["blurred by 6.0"]


def test_a_board_that_may_be_tilted_either_way_gives_no_pose(monkeypatch):
    """A few squares that are seen from afar look nearly the same from two sides. Without the rules some poses would be
    wrong by half a metre."""
    block = np.flatnonzero((np.arange(54) % 6 < 3) & (np.arange(54) // 6 < 3))
    camera, true = Lens(PINHOLE.intrinsics_px, SIZE), view(30, 65, 0.8)
    pixels, _ = project(SHEET.corners_m[block], true, camera.intrinsics_px)

    def wrong() -> tuple[list[float], set[str]]:
        rng = np.random.default_rng(0)
        found = [measure(SHEET, Corners(block, pixels + rng.normal(0, 0.3, pixels.shape)), camera) for _ in range(30)]
        return ([apart(one.world_from_camera, true)[0] for one in found if isinstance(one, Measured)],
                {one.reason for one in found if isinstance(one, Doubtful)})

    metres, reasons = wrong()
    assert max(metres, default=0.0) < 0.02
    assert any("may be tilted either way" in reason for reason in reasons)
    monkeypatch.setattr(board_pose, "CLEARLY_BETTER", -np.inf)
    monkeypatch.setattr(board_pose, "MAX_SIGMA_M", np.inf)
    monkeypatch.setattr(board_pose, "MAX_SIGMA_RAD", np.inf)
    assert max(wrong()[0]) > 0.5


def test_corners_that_fit_no_plane_give_no_pose():
    rng = np.random.default_rng(0)
    corners = Corners(np.arange(54), rng.uniform((100, 100), (500, 400), (54, 2)))
    assert "do not lie on one plane" in measure(SHEET, corners, PINHOLE).reason


# The filter.

def measured(world_from_camera, sigma_m=0.002, sigma_rad=0.004) -> Measured:
    return Measured(world_from_camera, np.diag(np.repeat([sigma_m, sigma_rad], 3) ** 2), 0.3, 50)


def track(rng, count=90, sigma_m=0.002, sigma_rad=0.004):
    """True and measured poses of a camera that goes along evenly, thirty times a second."""
    for k in range(count):
        true = look_at([0.4 * np.cos(0.01 * k), 0.4 * np.sin(0.01 * k), 0.3], [0.0, 0.0, 0.0])
        turn = Rotation.from_rotvec(rng.normal(0, sigma_rad, 3)).as_matrix()
        yield k / 30, true, measured(pose(turn @ true[:3, :3], true[:3, 3] + rng.normal(0, sigma_m, 3)),
                                     sigma_m, sigma_rad)


def test_the_filter_smooths_and_knows_how_wrong_it_is():
    filtered, raw, expected = [], [], []
    tracker = PoseFilter()
    for time_s, true, one in track(np.random.default_rng(0)):
        found = tracker.take(time_s, one)
        filtered.append(np.linalg.norm(found[:3, 3] - true[:3, 3]))
        raw.append(np.linalg.norm(one.world_from_camera[:3, 3] - true[:3, 3]))
        expected.append(np.trace(tracker.covariance[:3, :3]))
    assert tracker.refused == 0
    assert np.mean(filtered[10:]) < 0.85 * np.mean(raw[10:])
    assert 0.5 < np.mean(np.square(filtered[10:])) / np.mean(expected[10:]) < 1.5


def test_a_pose_that_jumps_is_refused_and_one_that_stays_is_taken():
    tracker, found = PoseFilter(), []
    steps = list(track(np.random.default_rng(1), 40))
    for k, (time_s, _, one) in enumerate(steps):
        jumped = one.world_from_camera.copy()
        jumped[0, 3] += 0.08 * (k == 20 or k >= 30)
        found.append(tracker.take(time_s, measured(jumped)))
    assert found[20] is None
    assert found[21] is not None
    assert [one is None for one in found[30:30 + RETURNS]] == [True] * (RETURNS - 1) + [False]
    assert all(one is not None for one in found[30 + RETURNS:])


def test_a_film_that_begins_anew_is_a_new_track():
    tracker = PoseFilter()
    tracker.take(5.0, measured(view(0, 50)))
    assert apart(tracker.take(0.0, measured(view(180, 50))), view(180, 50))[0] < 1e-9


# In the service.

@pytest.fixture
def folder(tmp_path):
    """Two images of the board, an image without it, and its description."""
    (tmp_path / "f").mkdir()
    for name, rgb in (("a.png", seen(view(20, 50))), ("b.png", np.full((480, 640, 3), 90, np.uint8)),
                      ("c.png", seen(view(140, 60)))):
        Image.fromarray(rgb).save(tmp_path / "f" / name)
    (tmp_path / "board.json").write_text(json.dumps(SHEET.model_dump(mode="json")))
    fx, fy, cx, cy = PINHOLE.intrinsics_px
    coefficients = [value for _, value in PINHOLE.distortion]
    (tmp_path / "camera.toml").write_text(
        f"size_px = [640, 480]\nintrinsics_px = {[fx, fy, cx, cy]}\ndistortion = {coefficients}\n")
    return tmp_path


def configured(folder, **values) -> Config:
    given = {"source": str(folder / "f"), "board": folder / "board.json", **values}
    return Config().with_values({f"camera.{key}": value for key, value in given.items()})


def test_the_service_takes_poses_from_the_board_and_leaves_out_images_without_it(folder):
    camera = build(configured(folder, calibration=str(folder / "camera.toml")))
    assert any(note.endswith("at the image's corner, is removed") for note in camera.notes)
    assert not any("camera.poses is not given" in note for note in camera.notes)
    first = camera.begin("r", 0)[1].message
    second = camera.next_frame()[0].message
    assert camera.next_frame() == []
    assert apart(first.world_from_camera, view(20, 50))[0] < 0.003
    assert apart(second.world_from_camera, view(140, 60))[0] < 0.003
    assert camera.skipped == 1


def test_a_source_without_the_board_says_why_no_image_has_a_pose(folder):
    for name in ("a.png", "c.png"):
        (folder / "f" / name).unlink()
    camera = build(configured(folder, calibration=str(folder / "camera.toml")))
    message = complaint(camera.begin, "r", 0)
    assert "none of the 1 images" in message
    assert "mostly because fewer than 8 corners of the board are found" in message


@pytest.mark.parametrize(("options", "words"), [
    (("--poses", "p.jsonl", "--calibration", "camera.toml"), "camera.board and camera.poses both tell"),
    ((), "camera.board needs the camera's intrinsics"),
    (("--calibration", "camera.toml", "--intrinsics", "600,600,320,240"), "both tell the intrinsics"),
    (("--calibration", "nobody"), "calibration "), (("--calibration", "a b"), "a camera cannot be named 'a b'")])
def test_what_does_not_go_together_is_one_line(monkeypatch, capsys, folder, options, words):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_DATA_HOME", str(folder / "data"))
    written(folder / "p.jsonl", line())
    given = ("run", "--world", "camera", "--source", "f", "--board", "board.json", *options)
    code, _, err = call(monkeypatch, capsys, *given)
    assert (code, err.count("\n")) == (2, 1)
    assert words in err
    assert not (folder / "runs").exists()
