"""Films of an episode: every step is in them, and they can be played."""

from __future__ import annotations

import sys

import av
import numpy as np
import pytest
from PIL import Image

from saccade.tests.fakes.logs import story, write
from saccade.tests.fixtures.make import GOLDEN
from saccade.tests.front_door import call

STEPS, RATE_HZ = 4, 4
LASTS = 2 * RATE_HZ  # frames for which the end stays


def frames_of(path) -> list[np.ndarray]:
    if path.suffix == ".gif":
        with Image.open(path) as film:
            return [np.asarray(film.seek(k) or film.convert("RGB")) for k in range(film.n_frames)]
    with av.open(str(path)) as film:
        assert film.streams.video[0].codec_context.name == "h264"
        return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]


@pytest.mark.parametrize(("name", "count"), [("run.mp4", STEPS + LASTS), ("run.gif", STEPS)])
def test_every_step_of_an_episode_is_in_its_film(monkeypatch, capsys, tmp_path, name, count):
    """What is filmed moves: the camera's image, the table from above, the curves."""
    code, out, err = call(monkeypatch, capsys, "film", GOLDEN, tmp_path / name, "--rate", RATE_HZ)
    assert (code, out) == (0, f"written to {tmp_path / name}\n"), err
    frames = frames_of(tmp_path / name)
    assert len(frames) == count
    height, width = frames[0].shape[:2]
    assert width / height == pytest.approx(16 / 9, abs=0.01)
    upper, lower, third = slice(height // 10, height // 2), slice(3 * height // 4, None), width // 3
    for place in ((upper, slice(0, third)), (upper, slice(third, 2 * third)), (lower, slice(0, third))):
        moved = np.abs(frames[0][place].astype(int) - frames[STEPS - 1][place]).max(-1) > 40
        assert moved.mean() > 0.002


def test_an_episode_is_chosen_and_what_is_not_known_is_left_out(monkeypatch, capsys, tmp_path):
    """Also a log without weights for its objects, with no percepts and no plans."""
    log = write(tmp_path / "run.mcap", (m for m in story(2, 3) if m[0].name not in ("percept", "plan")))
    code, _, err = call(monkeypatch, capsys, "film", log, tmp_path / "run.gif", "--episode", 0)
    assert code == 0, err
    assert len(frames_of(tmp_path / "run.gif")) == 3


@pytest.mark.parametrize(("arguments", "complaint"), [
    ((GOLDEN, "run.avi"), "run.avi cannot be a film: its name must end with .mp4 or .gif"),
    ((GOLDEN, "run.gif", "--episode", "3"), "has nothing of episode 3 in it"),
    (("nowhere.mcap", "run.gif"), "nowhere.mcap cannot be read"),
    ((GOLDEN, GOLDEN.parent / "nowhere" / ".." / "make.py" / "run.gif"), "cannot be written")])
def test_what_cannot_be_filmed_is_said_in_one_line(monkeypatch, capsys, tmp_path, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    code, _, err = call(monkeypatch, capsys, "film", *arguments)
    assert (code, err.count("\n")) == (2, 1)
    assert complaint in err
    assert list(tmp_path.iterdir()) == []


def test_without_an_encoder_it_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "av", None)
    code, _, err = call(monkeypatch, capsys, "film", GOLDEN, tmp_path / "run.mp4")
    assert code == 2
    assert "pip install 'saccade[film]'" in err
