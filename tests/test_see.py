"""`saccade see`: what it says about photographs, in which pixels, and what it does with files that are none."""

from __future__ import annotations

import dataclasses
import json
import os

import numpy as np
import pytest
from PIL import Image

from saccade.app.look import see as see_module
from saccade.app.look.fitting import Fitted
from saccade.app.look.see import Looker, artist_of, degrees, drawing_of, towards_camera
from saccade.services.perception.seen import Modes, Seen, bits
from saccade.shared.config import WEIGHTS, Config
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, pixel_rays, project
from saccade.tests.front_door import call

NAMES = names_of("pantry")
CELLS = 60
RED = (255, 0, 0)


class RedThings:
    """A model that takes whatever is red for the first object, and sees nothing of the others."""

    def __init__(self, square: bool = True):
        self.square, self.shapes, self.intrinsics = square, [], []

    def see(self, rgb, intrinsics_px, up, depth_m=None, *, alone=False) -> Seen:
        assert up == (0.0, 1.0, 0.0)
        self.shapes.append(rgb.shape)
        self.intrinsics.append(intrinsics_px)
        red = (rgb[..., 0] > 128) & (rgb[..., 1] < 128)
        count = len(NAMES)
        pixel = np.zeros((count, 2))
        pixel[0] = np.argwhere(red).mean(0)[::-1] + 0.5
        masks = np.zeros((count, CELLS, CELLS), bool)
        rows, columns = (((np.arange(CELLS) + 0.5) / CELLS * side).astype(int) for side in red.shape)
        masks[0] = red[rows][:, columns]
        presence = np.array([0.9, 0.3, 0.2, 0.1, 0.0])
        return Seen(presence, pixel, np.ones(count), np.full(count, 0.5), np.ones(count),
                    np.zeros((count, 8), np.float32), np.ones((count, 8), np.float32), np.zeros(count), bits(masks))


@pytest.fixture
def red_things(monkeypatch):
    """Puts RedThings in the place of the networks, and leaves the drawing out."""
    def put(square: bool = True) -> RedThings:
        model = RedThings(square)
        monkeypatch.setattr(see_module, "model_of", lambda *_: model)
        monkeypatch.setattr(see_module, "drawing_of", lambda *_: None)
        return model
    return put


def with_red(size, box, mode="RGB") -> Image.Image:
    image = Image.new("RGB", size, (60, 90, 90))
    image.paste(RED, box)
    return image.convert(mode)


def mask_of(entry) -> np.ndarray:
    """The mask [H, W] of an entry, by COCO's rules."""
    height, width = entry["mask"]["size"]
    counts = entry["mask"]["counts"]
    assert sum(counts) == height * width
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T


def seen(monkeypatch, capsys, tmp_path, *arguments):
    """Exit code, stdout, stderr and entries of the JSON file."""
    code, out, err = call(monkeypatch, capsys, "see", *arguments, "--json", tmp_path / "seen.json")
    return code, out, err, json.loads((tmp_path / "seen.json").read_text())


# --- pixels and masks

@pytest.mark.parametrize("square", [True, False])
@pytest.mark.parametrize(("size", "mode"), [((640, 480), "RGB"), ((300, 480), "RGBA"), ((2600, 2000), "P"),
                                            ((70, 90), "CMYK"), ((1000, 250), "RGB")])
def test_pixels_and_masks_are_those_of_the_photograph(monkeypatch, capsys, tmp_path, red_things, square, size, mode):
    """Whatever its size and mode, and whether the networks want a square."""
    red_things(square)
    width, height = size
    box = (width // 10, height // 2, width // 2, height)
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    with_red(size, box, mode).save(path)
    code, _, err, entries = seen(monkeypatch, capsys, tmp_path, path)
    assert (code, err) == (0, "")
    assert [entry["object"] for entry in entries] == list(NAMES)
    assert {entry["image"] for entry in entries} == {str(path)}
    first = entries[0]
    assert first["presence"] == pytest.approx(0.9)
    assert first["range_m"] == pytest.approx(0.8)
    truth = np.zeros((height, width), bool)
    truth[box[1]:box[3], box[0]:box[2]] = True
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    np.testing.assert_allclose(first["pixel"], (x, y), atol=max(size) / 200)
    mask = mask_of(first)
    assert mask.shape == truth.shape
    assert (mask & truth).sum() / (mask | truth).sum() > 0.85
    assert not any(mask_of(entry).any() for entry in entries[1:])
    assert all(entry["azimuth_deg"] is None for entry in entries)


@pytest.mark.parametrize("size", [(40, 32), (5000, 4000)])
def test_networks_get_images_of_bounded_size(red_things, tmp_path, size):
    path = tmp_path / "a.png"
    with_red(size, (0, 0, size[0] // 2, size[1] // 2)).save(path)
    for square in (True, False):
        model = red_things(square)
        photo = see_module.read_photograph(path, longest_px=see_module.LONGEST_PX)
        Looker(Config(), "sceneccn").look(photo)
        (height, width, _), = model.shapes
        assert max(height, width) <= 1280
        assert (height == width and 480 <= height <= 960) if square else (width / height == pytest.approx(1.25))
        assert model.intrinsics[0][0] == pytest.approx(max(height, width) / 2 / np.tan(np.pi / 6), rel=1e-3)


def test_networks_of_one_focal_length_are_told_ranges_of_the_photographs_own(monkeypatch, tmp_path, red_things):
    """They take the size in the image for that of the training's lens, which is longer: the object is nearer."""
    red_things()
    with_red((600, 400), (0, 0, 300, 200)).save(tmp_path / "a.png")
    photo = see_module.read_photograph(tmp_path / "a.png", (500, 500, 300, 200), longest_px=1280)
    looker = Looker(Config(), "sceneccn")
    assert looker.look(photo).sights[0].range_m == pytest.approx(0.8)
    monkeypatch.setattr(looker.weights, "architecture", "posecnn")
    assert looker.look(photo).sights[0].range_m == pytest.approx(0.8 * (500 / 600) / (INTRINSICS_PX[0] / 480))


# --- the networks that come with Saccade

@pytest.fixture(scope="module")
def rendered():
    """A soup can and a rice box: the image, and by name the pixel and the range in truth."""
    world = World(tuple(load_mesh("pantry", name) for name in NAMES))
    centers = {name: np.array([x, y, world.meshes[name].size_m[2] / 2])
               for name, x, y in (("soup_can", 0.08, -0.08), ("rice_box", -0.08, 0.08))}
    camera = look_at((0.45, 0.1, 0.4), (0, 0, 0.05))
    world.place({name: (center, 0.6) for name, center in centers.items()}, (90, 110, 130))
    image = world.render(camera)
    world.close()
    return image, {name: (project(center, camera, INTRINSICS_PX)[0], np.linalg.norm(center - camera[:3, 3]))
                   for name, center in centers.items()}


def test_a_rendered_photograph_is_seen_whole(monkeypatch, capsys, tmp_path, rendered):
    """Two objects are seen where they are, three are not; the pictures are there, and what is drawn is in them."""
    image, truth = rendered
    larger = Image.fromarray(image).resize((960, 960), Image.Resampling.BILINEAR)
    larger.save(tmp_path / "a.png")
    intrinsics = ",".join(f"{2 * x:.3f}" for x in INTRINSICS_PX)
    code, out, err, entries = seen(monkeypatch, capsys, tmp_path, tmp_path / "a.png", "--objects", "pantry",
                                   "--intrinsics", intrinsics, "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    assert "a.png (960x960 pixels): the intrinsics are those that you gave" in out
    assert len(entries) == 5
    for entry in entries:
        assert (entry["presence"] > 0.5) == (entry["object"] in truth), entry["object"]
        assert ("│ " + entry["object"] in out) == (entry["object"] in truth)
        assert np.isfinite([*entry["pixel"], entry["range_m"]]).all()
        if entry["object"] in truth:
            pixel, range_m = truth[entry["object"]]
            np.testing.assert_allclose(entry["pixel"], 2 * pixel, atol=24)
            assert entry["range_m"] == pytest.approx(range_m, rel=0.12)
            u, v = np.rint(2 * pixel).astype(int)
            assert mask_of(entry)[v, u]
    with Image.open(tmp_path / "out" / "a.seen.png") as picture:
        assert picture.size == (960, 960)
        changed = np.abs(np.asarray(picture).astype(int) - np.asarray(larger)).max(-1) > 0
    assert 2 * 96 * 96 < changed.sum() < 0.1 * changed.size  # two drawings, names and outlines, and nothing else


def test_networks_with_latent_poses_draw_what_they_mean(monkeypatch):
    """What is drawn is the decoded mean; networks that only estimate poses draw nothing."""
    weights = Weights(WEIGHTS / "pantry")
    artist = artist_of(weights, "soup_can")
    first, second = (drawing_of(artist, np.full(8, value, np.float32), None) for value in (0.0, 1.0))
    assert first.shape == (64, 64, 3)
    assert first.dtype == np.uint8
    assert not np.array_equal(first, second)
    monkeypatch.setattr(weights, "architecture", "posecnn")
    assert drawing_of(artist_of(weights, "soup_can"), np.zeros(8, np.float32), None) is None


# --- how objects are turned

@pytest.mark.parametrize("told_by", ["modes", "pose"])
def test_a_rotation_is_told_as_the_direction_of_the_camera(told_by):
    """A camera that looks past an object from azimuth 40 and elevation 25 degrees, in the object's frame."""
    world_from_camera = look_at(0.6 * direction(np.radians(40), np.radians(25)), (0.05, -0.02, 0.03))
    pixel, _ = project(np.zeros(3), world_from_camera, INTRINSICS_PX)
    rotation = world_from_camera[:3, :3].T
    image = Fitted(np.zeros((480, 480, 3), np.uint8), INTRINSICS_PX, (0, 0), (480, 480), (480, 480))
    base = RedThings().see(np.full((60, 60, 3), RED, np.uint8), INTRINSICS_PX, (0.0, 1.0, 0.0))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, 0.6 * pixel_rays(pixel, INTRINSICS_PX)
    modes = Modes(np.stack([rotation, np.eye(3)]), np.log([0.9, 0.1]), np.array([0.1, 0.1]))
    told = dataclasses.replace(base, pixel=pixel[None], **(
        {"modes": [modes]} if told_by == "modes" else {"camera_from_object": pose[None]}))
    np.testing.assert_allclose(degrees(towards_camera(told, 0, image)), (40, 25), atol=1e-6)
    vague = Modes(modes.rotations, modes.log_probability, np.full(2, np.pi))
    assert towards_camera(dataclasses.replace(told, modes=[vague]), 0, image) is None
    assert towards_camera(base, 0, image) is None
    assert degrees(None) is None


# --- what it says of files and options

def test_of_several_photographs_the_good_ones_are_told(monkeypatch, capsys, tmp_path, red_things):
    """Each bad one is a line, and the code says that there was one."""
    red_things()
    with_red((100, 80), (10, 10, 50, 50)).save(tmp_path / "a.png")
    with_red((80, 100), (10, 10, 50, 50)).save(tmp_path / "b.jpg")
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and more")
    os.mkfifo(tmp_path / "fifo.png")
    Image.new("RGB", (5, 5)).save(tmp_path / "tiny.png")
    names = ("a.png", "bad.png", "nowhere.png", "fifo.png", "tiny.png", ".", "b.jpg")
    code, out, err, entries = seen(monkeypatch, capsys, tmp_path, *(tmp_path / name for name in names))
    assert code == 2
    assert [entry["image"] for entry in entries[::5]] == [str(tmp_path / "a.png"), str(tmp_path / "b.jpg")]
    assert "a.png (100x80 pixels): the intrinsics are not known, and a horizontal field of view of 60 degrees" in out
    lines = err.splitlines()
    assert len(lines) == 5
    for line, name in zip(lines, names[1:6], strict=True):
        assert line.startswith(f"saccade: photograph {tmp_path / name} ".replace("/. ", " "))
    for words in ("is neither PNG nor JPEG", "No such file", "it is a FIFO", "is 5x5 pixels", "it is a folder"):
        assert words in err


def test_where_nothing_is_seen_no_table_is_printed(monkeypatch, capsys, tmp_path, red_things):
    model = red_things()
    unsure = {"presence": np.full(5, 0.5)}
    monkeypatch.setattr(model, "see", lambda *a, see=model.see, **k: dataclasses.replace(see(*a, **k), **unsure))
    with_red((100, 80), (10, 10, 50, 50)).save(tmp_path / "[red].png")
    code, out, _, entries = seen(monkeypatch, capsys, tmp_path, tmp_path / "[red].png", "--out", tmp_path)
    assert code == 0
    assert "[red].png (100x80 pixels)" in out
    assert "│" not in out
    assert "not seen (presence): " + ", ".join(f"{name} (0.50)" for name in NAMES) in out
    assert len(entries) == 5


def test_pictures_are_written_over_no_photograph_and_no_other_picture(monkeypatch, capsys, tmp_path, red_things):
    red_things()
    (tmp_path / "other").mkdir()
    paths = [tmp_path / "a.png", tmp_path / "a.jpg", tmp_path / "other" / "a.png", tmp_path / "a.seen.png"]
    for path in paths:
        with_red((100, 80), (10, 10, 50, 50)).save(path)
    before = [path.read_bytes() for path in paths]
    code, *_ = call(monkeypatch, capsys, "see", *paths, "--out", tmp_path)
    assert code == 0
    assert [path.read_bytes() for path in paths] == before
    assert {path.name for path in tmp_path.glob("a.seen*")} == {
        "a.seen.png", "a.seen-2.png", "a.seen-3.png", "a.seen-4.png", "a.seen.seen.png"}


@pytest.mark.parametrize(("arguments", "words"), [
    ((), "PHOTO... is missing"),
    (("a.png", "--agent", "random-walk"), "agent 'random-walk' has no networks that find objects in a picture: choose"),
    (("a.png", "--agent", "render-and-compare"), "has no networks that find objects in a picture: choose from"),
    (("a.png", "--agent", "nobody"), "agent 'nobody' is unknown"),
    (("a.png", "--intrinsics", "1,2"), "write fx,fy,cx,cy"),
    (("a.png", "--intrinsics", "a,b,c,d"), "write fx,fy,cx,cy"),
    (("a.png", "--objects", "fruit"), "object set 'fruit' is not there, or has no objects"),
    (("a.png", "--names", "teapot"), "'teapot' is not in 'pantry'"),
    (("a.png", "--weights", "none"), "none/manifest.json are missing"),
    (("a.png", "--json", "a.png"), "--json a.png is one of the photographs"),
    (("a.png", "--json", "none/a.json"), "name a file in a folder that is there"),
    (("a.png", "--out", "a.png"), "folder of pictures a.png cannot be written"),
])
def test_what_the_user_can_mend_is_one_line_and_code_2(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    with_red((100, 80), (10, 10, 50, 50)).save("a.png")
    before = (tmp_path / "a.png").read_bytes()
    code, out, err = call(monkeypatch, capsys, "see", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("saccade: ")
    assert words in err
    assert err.count("\n") == 1
    assert (tmp_path / "a.png").read_bytes() == before
