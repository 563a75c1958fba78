"""Photographs of any size and mode are read upright in RGB, with their intrinsics; goal images are made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from saccade.shared.world import images
from saccade.shared.world.geometry import INTRINSICS_PX, project
from saccade.shared.world.goal_image import read_goal_image
from saccade.shared.world.photographs import read_photograph
from saccade.tests.fakes.camera import HERE, centroid, complaint, dots
from saccade.tests.hostile import not_files

LARGE = 10_000


def exif(orientation: int = 1, **tags: object) -> Image.Exif:
    """EXIF data with tags by their names."""
    data = Image.Exif()
    data[Base.Orientation] = orientation
    data.get_ifd(IFD.Exif).update({Base[name].value: value for name, value in tags.items()})
    return data


def quarters(size=(64, 48)) -> Image.Image:
    """A picture that is red on the left above, green on the right above, blue on the left below, white on the right."""
    small = Image.new("RGB", (2, 2))
    for place, colour in zip(((0, 0), (1, 0), (0, 1), (1, 1)), ((250, 0, 0), (0, 250, 0), (0, 0, 250), (250,) * 3),
                             strict=True):
        small.putpixel(place, colour)
    return small.resize(size, Image.Resampling.NEAREST)


def corner(rgb: np.ndarray, *place: int) -> list[int]:
    """The colour in a quarter of a picture."""
    height, width = rgb.shape[:2]
    return rgb[(2 * place[1] + 1) * height // 4, (2 * place[0] + 1) * width // 4].tolist()


# --- modes

@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "CMYK", "L", "LA", "1", "I;16"])
def test_a_picture_of_any_mode_is_one_in_rgb(tmp_path, mode):
    """Colours stay where the mode has colours, and a light grey stays light."""
    picture = quarters().convert("L").convert("I;16").point(lambda x: x * 257) if mode == "I;16" else \
        quarters().convert(mode)
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    picture.save(path, **({"quality": 100} if mode == "CMYK" else {}))
    with Image.open(path) as saved:
        assert saved.mode == mode
    rgb = read_photograph(path, longest_px=LARGE).rgb
    assert (rgb.shape, rgb.dtype) == ((48, 64, 3), np.uint8)
    assert min(corner(rgb, 1, 1)) > 240
    if mode in ("RGB", "RGBA", "P", "CMYK"):
        for place, channel in (((0, 0), 0), ((1, 0), 1), ((0, 1), 2)):
            colour = corner(rgb, *place)
            assert colour[channel] > 180
            assert max(colour[:channel] + colour[channel + 1:]) < 80
    elif mode != "1":  # green is lighter than red, and red than blue
        assert corner(rgb, 1, 0) > corner(rgb, 0, 0) > corner(rgb, 0, 1)


def test_what_is_transparent_is_black(tmp_path):
    """As a channel, as one colour of a palette, and as one colour."""
    picture = quarters()
    clear = np.array(picture.convert("RGBA"))
    clear[:24, :32, 3] = 0
    Image.fromarray(clear).save(tmp_path / "channel.png")
    palette = picture.quantize(4)
    palette.save(tmp_path / "palette.png", transparency=palette.getpixel((0, 0)))
    picture.save(tmp_path / "colour.png", transparency=(250, 0, 0))
    for name in ("channel", "palette", "colour"):
        rgb = read_photograph(tmp_path / f"{name}.png", longest_px=LARGE).rgb
        assert corner(rgb, 0, 0) == [0, 0, 0], name
        assert corner(rgb, 1, 1) == [250, 250, 250], name


# --- upright, and smaller

@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
def test_a_photograph_is_turned_upright(tmp_path, name, orientation):
    """Pillow's own function for this is the yardstick; intrinsics that are given are those of the upright picture."""
    path = tmp_path / name
    quarters().save(path, exif=exif(orientation))
    photo = read_photograph(path, (50, 51, 20, 30), longest_px=LARGE)
    with Image.open(path) as image:
        np.testing.assert_array_equal(photo.rgb, np.asarray(ImageOps.exif_transpose(image)))
    assert photo.size_px == ((64, 48) if orientation < 5 else (48, 64))
    assert photo.intrinsics_px == (50, 51, 20, 30)


@pytest.mark.parametrize(("name", "mode"), [("a.jpg", "RGB"), ("a.jpg", "CMYK"), ("a.png", "RGBA"), ("a.png", "P")])
def test_a_large_photograph_is_made_smaller_with_its_intrinsics(tmp_path, name, mode):
    quarters((1000, 700)).convert(mode).save(tmp_path / name, exif=exif(6))
    photo = read_photograph(tmp_path / name, (800, 900, 350, 500), longest_px=200)
    assert photo.rgb.shape == (200, 140, 3)
    assert photo.size_px == (700, 1000)
    np.testing.assert_allclose(photo.intrinsics_px, (160, 180, 70, 100), rtol=1e-9)
    assert corner(photo.rgb, 1, 0)[0] > 180  # red was on the left above, and is turned to the right
    assert corner(photo.rgb, 1, 0)[2] < 80


# --- intrinsics

def test_given_intrinsics_are_before_exif_and_exif_before_an_assumption(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (400, 300)).save(path, exif=exif(FocalLengthIn35mmFilm=50))
    given = read_photograph(path, (500, 510, 190, 140), longest_px=LARGE)
    assert given.intrinsics_px == (500, 510, 190, 140)
    assert "you gave" in given.told
    known = read_photograph(path, longest_px=LARGE)
    np.testing.assert_allclose(known.intrinsics_px, (577.81, 577.81, 200, 150), atol=0.01)  # 50 mm / 43.27 mm of 500 px
    assert "EXIF" in known.told
    assert not known.assumed
    Image.new("RGB", (400, 300)).save(path)
    assumed = read_photograph(path, longest_px=LARGE)
    assert assumed.assumed
    assert "60 degrees is assumed" in assumed.told
    fx, _, cx, _ = assumed.intrinsics_px
    assert 2 * math.degrees(math.atan(cx / fx)) == pytest.approx(60)


@pytest.mark.parametrize(("unit", "per_unit"), [(None, 2540), (2, 2540), (3, 1000), (4, 100)])
def test_a_focal_length_on_the_sensor_is_counted_in_its_unit(tmp_path, unit, per_unit):
    """100 pixels a millimetre and 5 mm: 500 pixels, of a picture that was made half as large since."""
    named = {} if unit is None else {"FocalPlaneResolutionUnit": unit}
    path = tmp_path / "a.jpg"
    Image.new("RGB", (400, 300)).save(path, exif=exif(
        FocalLength=IFDRational(5), FocalPlaneXResolution=IFDRational(per_unit), ExifImageWidth=800, **named))
    photo = read_photograph(path, longest_px=LARGE)
    np.testing.assert_allclose(photo.intrinsics_px, (250, 250, 200, 150), rtol=1e-6)


@pytest.mark.parametrize("tags", [
    {"FocalLengthIn35mmFilm": 0}, {"FocalLengthIn35mmFilm": 60_000}, {"FocalLength": IFDRational(5)},
    {"FocalLength": IFDRational(5), "FocalPlaneXResolution": IFDRational(100), "FocalPlaneResolutionUnit": 77}])
def test_exif_data_that_tell_no_focal_length_leave_it_assumed(tmp_path, tags):
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=exif(**tags))
    assert read_photograph(tmp_path / "a.jpg", longest_px=LARGE).assumed


def test_damaged_exif_data_are_no_harm(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "a.jpg"
    for _ in range(100):
        quarters().save(path, exif=b"Exif\0\0MM\0*\0\0\0\x08" + rng.integers(0, 256, 60, np.uint8).tobytes())
        assert sorted(read_photograph(path, longest_px=LARGE).size_px) == [48, 64]


@pytest.mark.parametrize("given", [(0, 500, 200, 150), (-500, 500, 200, 150), (math.nan, 500, 200, 150),
                                   (500, math.inf, 200, 150), (500, 500, 1e9, 150), (500, 500, 200, math.nan)])
def test_intrinsics_that_cannot_be_are_refused(tmp_path, given):
    Image.new("RGB", (400, 300)).save(tmp_path / "a.png")
    told = complaint(read_photograph, tmp_path / "a.png", given, longest_px=LARGE)
    assert "cannot be those of photograph" in told
    assert "400x300 pixels: give fx,fy,cx,cy" in told


# --- hostile files

@pytest.mark.parametrize("size", [(1, 1), (31, 200), (32, 2000)])
def test_a_picture_too_small_or_too_narrow_is_refused(tmp_path, size):
    Image.new("RGB", size).save(tmp_path / "a.png")
    assert f"is {size[0]}x{size[1]} pixels: give one of at least" in complaint(
        read_photograph, tmp_path / "a.png", longest_px=LARGE)


def test_what_is_no_whole_picture_is_refused(tmp_path, monkeypatch):
    quarters().save(tmp_path / "a.gif")
    (tmp_path / "cut.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for name in ("a.gif", "cut.png"):
        assert "is neither PNG nor JPEG" in complaint(read_photograph, tmp_path / name, longest_px=LARGE)
    quarters().save(tmp_path / "a.png")
    monkeypatch.setattr(images, "MAX_PIXELS", 64 * 48 - 1)
    assert "has 64x48 pixels, more than" in complaint(read_photograph, tmp_path / "a.png", longest_px=LARGE)
    (tmp_path / "others").mkdir()
    for kind, path in not_files(tmp_path / "others").items():
        assert f"it is {kind}, not a file" in complaint(read_photograph, path, longest_px=LARGE)


# --- goal images

def test_a_goal_image_of_480_that_says_nothing_is_taken_as_it_is(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (480, 480, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    goal = read_goal_image(tmp_path / "a.png")
    np.testing.assert_array_equal(goal.rgb, pixels)
    assert "those of the simulator are assumed" in goal.note
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    with Image.open(tmp_path / "a.jpg") as image:
        np.testing.assert_array_equal(read_goal_image(tmp_path / "a.jpg").rgb, np.asarray(image))
    assert not np.array_equal(read_goal_image(tmp_path / "a.png", (700, 700, 240, 240)).rgb, pixels)
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif(FocalLengthIn35mmFilm=28))
    assert "EXIF" in read_goal_image(tmp_path / "a.png").note


@pytest.mark.parametrize(("size", "intrinsics"), [
    ((1280, 720), (910.0, 905.0, 652.3, 351.8)), ((5000, 4000), (4500.0, 4500.0, 2500.0, 2000.0)),
    ((700, 900), (800.0, 800.0, 350.0, 450.0))])
def test_points_of_a_goal_image_are_where_the_simulators_camera_would_see_them(tmp_path, size, intrinsics):
    points = np.array([[0.0, 0.0, 0.0], [0.06, 0.05, 0.0], [-0.07, 0.04, 0.1]])
    drawn, _ = project(points, HERE, intrinsics)
    Image.fromarray(dots(drawn, size)).save(tmp_path / "a.png")
    goal = read_goal_image(tmp_path / "a.png", intrinsics)
    expected, _ = project(points, HERE, INTRINSICS_PX)
    for place in expected:
        np.testing.assert_allclose(centroid(goal.rgb, place), place, atol=0.3)


def test_outside_of_its_picture_a_goal_image_is_black(tmp_path):
    """A narrow lens: the middle is the picture, and what is around it is not known."""
    Image.new("RGB", (600, 400), (200, 200, 200)).save(tmp_path / "a.png")
    goal = read_goal_image(tmp_path / "a.png", (2 * INTRINSICS_PX[0], 2 * INTRINSICS_PX[1], 300, 200))
    seen = goal.rgb.max(-1) > 0
    assert seen.sum() == pytest.approx(300 * 200, abs=600)
    assert goal.rgb[seen].min() == 200
    assert "covers 26% of the networks' field of view, and the rest is black" in goal.note
    told = complaint(read_goal_image, tmp_path / "a.png", (1500, 1500, -1100, 200))
    assert "shows nothing of the networks' field of view" in told
