"""Where images come from: in order, with their times, right way up; what cannot be read is refused in one line."""

from __future__ import annotations

import builtins
import threading

import av
import numpy as np
import pytest
from PIL import Image

from saccade.services.camera import sources
from saccade.services.camera.sources import Webcam, open_source
from saccade.tests.fakes.camera import complaint, folder_of

cv2 = sources._cv2()  # as the source loads it: quiet


def test_a_folder_is_sorted_as_people_count_with_times_by_its_rate(tmp_path):
    """img10 comes after img2; what is hidden or no image is left out."""
    folder_of(tmp_path, ["img2.png", "img10.PNG", "img1.png", "._img1.png"])
    (tmp_path / "notes.txt").write_text("no image")
    images = list(open_source(str(tmp_path), rate_hz=4.0))
    assert [i.name for i in images] == ["img1.png", "img2.png", "img10.PNG"]
    assert [i.index for i in images] == [0, 1, 2]
    assert [i.time_s for i in images] == [0.0, 0.25, 0.5]
    assert [int(i.rgb[0, 0, 0]) for i in images] == [2, 0, 1]
    assert images[0].rgb.shape == (48, 64, 3)
    assert images[0].rgb.dtype == np.uint8


def test_a_folder_can_be_gone_through_again(tmp_path):
    source = open_source(str(folder_of(tmp_path, ["a.png", "b.png"])))
    assert [i.name for i in source] == [i.name for i in source] == ["a.png", "b.png"]


def test_an_image_is_upright_as_viewers_show_it(tmp_path):
    """Orientation 6: the first row of the file is the right column of the picture, in its size too."""
    stored = np.zeros((4, 6, 3), dtype=np.uint8)
    stored[0] = 200
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(stored).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    source = open_source(str(tmp_path))
    image = next(iter(source)).rgb
    assert source.size_px == (4, 6)
    assert image.shape == (6, 4, 3)
    np.testing.assert_allclose(image[:, 3], 200, atol=20)
    np.testing.assert_allclose(image[:, :3], 0, atol=20)


@pytest.mark.parametrize(("name", "code"), [("a.mp4", "mp4v"), ("a.avi", "MJPG")])
def test_a_video_gives_its_frames_in_rgb_with_their_times(tmp_path, name, code):
    """Twice, since a video may be looped. Red rises from frame to frame, blue stays: no channels are exchanged."""
    writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*code), 8.0, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), (30, 0, 40 * k), dtype=np.uint8))  # OpenCV's order: blue, green, red
    writer.release()
    source = open_source(str(tmp_path / name))
    assert source.size_px == (64, 48)
    assert source.period_s == pytest.approx(1 / 8)
    for _ in range(2):
        images = list(source)
        assert [i.index for i in images] == [0, 1, 2, 3, 4]
        np.testing.assert_allclose([i.time_s for i in images], np.arange(5) / 8, atol=1e-6)
        means = np.array([i.rgb.reshape(-1, 3).mean(0) for i in images])
        np.testing.assert_allclose(means[:, 0], 40 * np.arange(5), atol=8)
        np.testing.assert_allclose(means[:, 2], 30, atol=8)


def test_a_video_that_breaks_off_says_after_how_many_frames(tmp_path):
    """What is whole is seen first; the rest does not go missing without a word."""
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for _ in range(20):
        writer.write(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
    writer.release()
    whole = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(whole[:len(whole) // 2])
    images = iter(open_source(str(tmp_path / "a.avi")))
    seen = []
    message = complaint(lambda: [seen.append(image.index) for image in images])
    assert 5 < len(seen) < 15
    assert f"a.avi breaks off after {len(seen)} of 20 frames" in message


class FakeCapture:
    """A device in the test's hands: `show` gives it its next image, None takes it off the machine; while it is
    `running` it shows black without waiting."""

    def __init__(self):
        self.images, self.asked, self.released = [np.zeros((48, 64, 3), np.uint8)], threading.Semaphore(0), False
        self.there, self.running = threading.Semaphore(1), False

    def show(self, value):
        self.images.append(None if value is None else np.full((48, 64, 3), value, dtype=np.uint8))
        self.there.release()

    def isOpened(self):
        return True

    def read(self):
        self.asked.release()
        if self.running:
            return True, np.zeros((48, 64, 3), dtype=np.uint8)
        self.there.acquire(timeout=60)
        image = self.images.pop(0) if self.images else None
        return image is not None, image

    def release(self):
        self.released = True


@pytest.fixture
def device(monkeypatch):
    capture = FakeCapture()
    monkeypatch.setattr(sources, "_capture", lambda what: capture)
    return capture


def test_a_webcam_shows_its_newest_image(device):
    """Drivers keep a queue: whoever looks away for two images sees the third, with its time, not the oldest."""
    webcam = Webcam(0, 10.0, clock=iter(range(7, 100)).__next__)
    assert webcam.size_px == (64, 48)
    assert webcam.endless
    images = iter(webcam)
    device.show(1)
    first = next(images)
    assert (first.index, first.time_s, int(first.rgb[0, 0, 0])) == (0, 0, 1)
    for value in (2, 3, 4):
        device.show(value)
    for _ in range(6):  # asked for its size, for the four, and once more: so the last has arrived
        assert device.asked.acquire(timeout=60)
    newest = next(images)
    assert (newest.index, newest.time_s, int(newest.rgb[0, 0, 0])) == (1, 3, 4)
    device.show(None)
    assert "webcam:0 gives no image" in complaint(next, images)
    assert device.released


def test_a_webcam_is_given_back_when_nobody_looks_any_more(device, monkeypatch):
    monkeypatch.setattr(sources, "RELEASE_S", 60.0)
    images = iter(Webcam(0))
    device.show(1)
    next(images)
    device.released, device.running = False, True
    device.show(2)
    images.close()
    assert device.released


@pytest.mark.parametrize("text", ["webcam:3", "/dev/video3"])
def test_a_webcam_goes_by_its_number(monkeypatch, text):
    asked = []
    monkeypatch.setattr(sources, "_capture", lambda what: asked.append(what) or FakeCapture())
    assert open_source(text, rate_hz=5.0).period_s == 0.2
    assert asked == [3]


def test_a_webcam_that_is_not_there_is_refused():
    for number in ("9" * 20, "9" * 5000):
        assert "give a number of at most 4 digits" in complaint(open_source, f"webcam:{number}")
    assert "webcam:99 does not open" in complaint(open_source, "webcam:99")


def bad_sources(folder):
    (folder / "empty").mkdir()
    (folder / "rubbish.mp4").write_bytes(b"no video" * 100)
    (folder / "nothing.mp4").write_bytes(b"")
    folder_of(folder / "sizes", ["a.png", "b.png"])
    Image.new("RGB", (48, 64)).save(folder / "sizes" / "c.png")
    (folder_of(folder / "damaged", ["a.png"]) / "b.png").write_bytes(b"no image")
    Image.new("L", (64, 48)).save(folder_of(folder / "grey", ["a.png"]) / "b.png")


@pytest.mark.parametrize(("name", "words"), [
    ("nowhere", "nowhere is not there: give a folder"), ("empty", "holds no image"), ("webcam:x", "is not there"),
    ("rubbish.mp4", "rubbish.mp4 cannot be read"), ("nothing.mp4", "nothing.mp4 cannot be read"),
    ("sizes", "c.png is 48x64 pixels, a.png is 64x48"), ("damaged", "b.png is neither PNG nor JPEG"),
    ("grey", "b.png has mode L"), ("sizes/a.png", "is a single image: give the folder")])
def test_a_bad_source_is_refused_before_anything_runs(tmp_path, capfd, name, words):
    """In one line of ours: the libraries below say nothing of their own."""
    bad_sources(tmp_path)
    assert words in complaint(open_source, str(tmp_path / name))
    assert capfd.readouterr() == ("", "")


def test_an_image_that_breaks_off_is_named_when_it_is_reached(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(tmp_path / name)
    whole = (tmp_path / "b.png").read_bytes()
    (tmp_path / "b.png").write_bytes(whole[:len(whole) // 2])
    images = iter(open_source(str(tmp_path)))
    next(images)
    assert f"image {tmp_path / 'b.png'} cannot be read" in complaint(next, images)


def test_without_pyav_a_video_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").write_bytes(b"x")
    real = builtins.__import__

    def without_av(name, *more, **others):
        if name == "av":
            raise ImportError("No module named 'av'")
        return real(name, *more, **others)

    monkeypatch.setattr(builtins, "__import__", without_av)
    assert "pip install 'saccade[camera]'" in complaint(open_source, str(tmp_path / "a.mp4"))


def filmed(path, codec="libx264", first_s=0, **options):
    """A film of ten frames a second that become redder, written with PyAV."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for k in range(10):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), (20 * k, 30, 30), np.uint8), format="rgb24")
            frame.pts = k + round(10 * first_s)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("film", [
    {"path": "a.mp4", "x264-params": "tff=1:interlaced=1"}, {"path": "a.mkv", "first_s": 5},
    {"path": "a.webm", "codec": "libvpx"}])
def test_a_film_is_read_whole_interlaced_or_begun_late(tmp_path, film):
    """Some containers tell a length from zero on, and no number of frames."""
    path = tmp_path / film.pop("path")
    filmed(path, **film)
    images = list(open_source(str(path)))
    np.testing.assert_allclose([i.time_s for i in images], np.arange(10) / 10, atol=1e-3)
    np.testing.assert_allclose([i.rgb[..., 0].mean() for i in images], 20 * np.arange(10), atol=12)
