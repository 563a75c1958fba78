"""The picture of a run, drawn from its log alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from saccade.app.look.picture import draw, read_story
from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import Belief, Frame, Goal, Truth
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, TRUTH
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.recording import RunLog

RNG = np.random.default_rng(0)


def pose_at(x, y):
    pose = np.eye(4)
    pose[:3, 3] = x, y, 0.4
    return pose


def image(grey):
    return np.full((48, 48, 3), grey, dtype=np.uint8)


def write_log(path, *, episodes=2, steps=3, presence=0.9, configuration="{}", truth=True, close=True):
    """A mug at (0.2, 0.1) that is believed there; the camera goes along y = 0.1 episode. The last step has no frame."""
    log = RunLog(path, world="table", configuration=configuration)
    for episode in range(episodes):
        stamp = {"run": "r", "episode": episode}
        goal = Goal(**stamp, step=0, rgb=image(50 + episode), intrinsics_px=np.ones(4))
        log.write(GOAL, None, encode(goal))
        for step in range(steps):
            camera = pose_at(0.1 * step, 0.1 * episode)
            belief = Belief(
                **stamp, step=step, object="mug", presence=presence, world_from_camera=camera, views=step,
                mean_m=np.array([0.2, 0.1, 0.05]), covariance_m2=np.eye(3) * 1e-3,
                particles_m=RNG.normal((0.2, 0.1, 0.05), 0.03, (200, 3)).astype(np.float32))
            frame = Frame(**stamp, step=step, rgb=image(100 + step), intrinsics_px=np.ones(4), world_from_camera=camera)
            if step < steps - 1:
                log.write(FRAME, None, encode(frame))
                log.write(BELIEF, "mug", encode(belief))
            if truth:
                told = Truth(**stamp, step=step, scene="s", target="mug", names=["mug"],
                             centers_m=np.array([[0.2, 0.1, 0.05]]), yaws_rad=np.zeros(1), keep_out_m=np.ones(1),
                             target_center_m=np.array([0.2, 0.1, 0.05]), world_from_camera=camera,
                             goal_world_from_camera=pose_at(-0.3, -0.3), success=False, done=step == steps - 1)
                log.write(TRUTH, None, encode(told))
    if close:
        log.close()
    return log


def pixels_of(path, colour):
    """How many pixels of a picture are near a colour."""
    picture = np.asarray(Image.open(path).convert("RGB"), dtype=float)
    return int((np.abs(picture - 255 * np.array(to_rgb(colour))).max(axis=2) < 12).sum())


def test_story_is_the_last_episode_unless_another_is_asked_for(tmp_path):
    write_log(tmp_path / "run.mcap")
    last, first = read_story(tmp_path / "run.mcap"), read_story(tmp_path / "run.mcap", 0)
    assert (last.episode, first.episode) == (1, 0)
    assert np.allclose(last.path_m, [[0, 0.1, 0.4], [0.1, 0.1, 0.4], [0.2, 0.1, 0.4]])
    assert np.allclose(first.path_m, [[0, 0, 0.4], [0.1, 0, 0.4], [0.2, 0, 0.4]])
    assert (last.goal_rgb[0, 0, 0], first.goal_rgb[0, 0, 0]) == (51, 50)
    assert (last.last_rgb[0, 0, 0], last.last_step) == (101, 1)


def test_picture_shows_the_beliefs_in_what_is_there_alone(tmp_path):
    """The mug's particles have its colour; one that is not believed to be there leaves none."""
    write_log(tmp_path / "run.mcap")
    write_log(tmp_path / "absent.mcap", presence=0.1)
    draw(tmp_path / "run.mcap", tmp_path / "there.png")
    draw(tmp_path / "absent.mcap", tmp_path / "absent.png")
    with Image.open(tmp_path / "there.png") as picture:
        assert picture.size == (2100, 520)
    assert pixels_of(tmp_path / "there.png", COLOURS[0]) > 20
    assert pixels_of(tmp_path / "absent.png", COLOURS[0]) == 0


def test_picture_shows_goal_and_last_view(tmp_path):
    write_log(tmp_path / "run.mcap", episodes=1)
    draw(tmp_path / "run.mcap", tmp_path / "p.png")
    for grey in (50, 101):  # each fills a panel
        assert pixels_of(tmp_path / "p.png", (grey / 255,) * 3) > 100_000


def test_goal_from_elsewhere_has_no_known_view(tmp_path):
    """The simulator's goal pose says nothing about the user's image."""
    write_log(tmp_path / "own.mcap")
    write_log(tmp_path / "image.mcap", configuration=json.dumps({"scene": {"goal_image": "mug.png"}}))
    assert read_story(tmp_path / "own.mcap").goal_is_known
    assert not read_story(tmp_path / "image.mcap").goal_is_known


def test_log_of_a_camera_has_no_truth(tmp_path):
    """The path is that of the frames."""
    write_log(tmp_path / "run.mcap", truth=False)
    story = draw(tmp_path / "run.mcap", tmp_path / "p.png")
    assert story.truth is None
    assert len(story.path_m) == 2


def test_cut_log_is_drawn_as_far_as_it_goes(tmp_path):
    """As a killed recorder leaves it: one chunk whole, the next one cut."""
    path = tmp_path / "run.mcap"
    log = write_log(path, episodes=1, close=False)
    log._flushed_s = 0.0
    log.flush_if_due()
    whole = path.stat().st_size
    frame = Frame(run="r", episode=0, step=3, rgb=RNG.integers(0, 255, (48, 48, 3), dtype=np.uint8),
                  intrinsics_px=np.ones(4), world_from_camera=pose_at(0.4, 0.4))
    log.write(FRAME, None, encode(frame))
    log.close()
    assert len(read_story(path).path_m) == 4
    with path.open("r+b") as file:
        file.truncate(whole + 500)
    story = draw(path, tmp_path / "p.png")
    assert np.allclose(story.path_m[-1], [0.2, 0.0, 0.4])
    assert len(story.path_m) == 3


def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path):
    write_log(tmp_path / "run.mcap")
    with pytest.raises(SaccadeError, match="nothing of episode 7"):
        draw(tmp_path / "run.mcap", tmp_path / "p.png", 7)
    with pytest.raises(SaccadeError, match=r"p\.png cannot be written"):
        draw(tmp_path / "run.mcap", tmp_path / "none" / "p.png")
    with pytest.raises(SaccadeError, match="cannot be read"):
        draw(tmp_path / "none.mcap", tmp_path / "p.png")
