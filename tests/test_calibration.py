"""`saccade calibrate` finds the lens of rendered views, and refuses what leaves it open."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from saccade.services.camera.calibration import Calibration, read_calibration
from saccade.services.camera.core import build
from saccade.shared.config import Config
from saccade.tests.fakes.board import FISHEYE, PINHOLE, SHEET, seen, view
from saccade.tests.front_door import call
from saccade.tests.hostile import complaint

cv2 = pytest.importorskip("cv2")
VIEWS = 12
SIZE_PX, INTRINSICS = "size_px = [640, 480]", "intrinsics_px = [600, 600, 320, 240]"


def taken(folder, poses, camera):
    """A folder with an image of the board from each pose, with noise, and the board's description."""
    (folder / "f").mkdir()
    rng = np.random.default_rng(0)
    for k, pose in enumerate(poses):
        noisy = seen(pose, camera) + 3 * rng.standard_normal((480, 640, 3), np.float32)
        Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(folder / "f" / f"{k}.png")
    (folder / "board.json").write_text(json.dumps(SHEET.model_dump(mode="json")))
    return folder


def around(range_m):
    rng = np.random.default_rng(1)
    return [view(360 * k / VIEWS * 3, rng.uniform(42, 80), rng.uniform(range_m, 1.3 * range_m),
                 rng.uniform(-180, 180), rng.uniform(-0.06, 0.06, 2)) for k in range(VIEWS)]


@pytest.mark.parametrize(("camera", "model", "range_m"), [(PINHOLE, "pinhole", 0.32), (FISHEYE, "fisheye", 0.2)])
def test_it_recovers_the_lens_of_rendered_views(monkeypatch, capsys, tmp_path, camera, model, range_m):
    taken(tmp_path, around(range_m), camera)
    code, out, _ = call(monkeypatch, capsys, "calibrate", tmp_path / "f", "--board", tmp_path / "board.json", "--model",
                        model, "--out", tmp_path / "c.toml")
    assert code == 0
    assert f"{VIEWS} of {VIEWS} images show enough of the board" in out
    found = read_calibration(str(tmp_path / "c.toml"))
    assert found.rms_px < 0.3
    np.testing.assert_allclose(found.intrinsics_px[:2], camera.intrinsics_px[:2], rtol=0.004)
    np.testing.assert_allclose(found.intrinsics_px[2:], camera.intrinsics_px[2:], atol=1.0)
    rays = np.random.default_rng(2).uniform(-0.3, 0.3, (100, 2))
    np.testing.assert_allclose(found.lens.pixels(rays), camera.pixels(rays), atol=0.6)
    with Image.open(tmp_path / "c.png") as picture:
        assert min(picture.size) > 400


@pytest.mark.parametrize(("poses", "words"), [
    ([view(20, 50)] * 9, "9 images show the board, of which 1 differ enough"),
    (around(0.3)[:4], "4 images show the board, of which 4 differ enough, and 8 are needed"),
    ([view(0, 89.9, 0.5, 0, (x, y)) for x in (-0.06, 0.0, 0.06) for y in (-0.05, 0.0, 0.05)], "too alike")],
    ids=["still", "few", "never tilted"])
def test_too_few_or_too_similar_views_are_refused_in_one_line(monkeypatch, capsys, tmp_path, poses, words):
    taken(tmp_path, poses, PINHOLE)
    code, _, err = call(monkeypatch, capsys, "calibrate", tmp_path / "f", "--board", tmp_path / "board.json", "--out",
                        tmp_path / "c.toml")
    assert code == 2
    assert words in err
    assert "film the board from many sides" in err
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.parametrize(("text", "words"), [
    ("", "size_px"), ("size_px = ", "is not TOML"), (f"{SIZE_PX}\nintrinsics_px = [0, 600, 320, 240]", "no camera"),
    (f"{SIZE_PX}\n{INTRINSICS}\ndistortion = [1, 2, 3]", "a pinhole has 0 or 4 or 5 or 8"),
    (f"{SIZE_PX}\nintrinsics_px = [600, nan, 320, 240]", "finite"),
    (f"{SIZE_PX}\n{INTRINSICS}\nmodel = 'fisheye'", "a fisheye has 4")])
def test_a_damaged_calibration_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "c.toml"
    path.write_text(text)
    message = complaint(read_calibration, str(path))
    assert message.startswith(f"calibration {path}")
    assert words in message


def test_a_calibration_is_kept_under_a_name(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    made = Calibration(size_px=(640, 480), model="fisheye", intrinsics_px=(330.0, 331.0, 318.0, 242.0),
                       distortion=(0.03, -0.012, 0.003, -0.001), rms_px=0.2, views=20)
    made.write(tmp_path / "saccade" / "cameras" / "desk.toml")
    assert read_calibration("desk") == made
    assert read_calibration("desk").lens == FISHEYE


def test_a_calibration_is_for_images_of_its_shape_in_any_size(tmp_path):
    Calibration(size_px=(640, 480), intrinsics_px=PINHOLE.intrinsics_px).write(tmp_path / "c.toml")
    for size in ((320, 240), (320, 320)):
        folder = tmp_path / f"{size[1]}"
        folder.mkdir()
        Image.new("RGB", size).save(folder / "a.png")
    given = {"camera.calibration": str(tmp_path / "c.toml")}
    camera = build(Config().with_values(given | {"camera.source": str(tmp_path / "240")}))
    assert any("intrinsics (305.00, 306.00, 162.50, 118.00) px are those of the calibration" in x for x in camera.notes)
    wrong = Config().with_values(given | {"camera.source": str(tmp_path / "320")})
    assert "the intrinsics of the calibration are for images of 640x480 pixels" in complaint(build, wrong)
