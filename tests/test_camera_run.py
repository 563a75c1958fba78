"""A film of the table through the real services: what stands there is found, and what does not is not."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from saccade.app.log.check import missing
from saccade.app.look.picture import draw_run, read_story
from saccade.app.replay.replay import prepare, replay_here, replay_on_bus
from saccade.app.run.display import Display, line, panel
from saccade.app.run.run import in_world, run
from saccade.services.replayer.core import Keys, Pace
from saccade.services.viewer.server import free_port
from saccade.shared.bus.messages import Belief, Frame, Plan, Status
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.tests.fakes import ros
from saccade.tests.fakes.bags import grey
from saccade.tests.fakes.camera import LENS_PX, film, folder_of, written
from saccade.tests.fakes.camera import line as pose_line
from saccade.tests.fakes.logs import so_far
from saccade.tests.front_door import call
from saccade.tests.samples import sample

VIEWS = 32
WAIT_S = 120  # for what must come; nothing is asserted about how long it takes


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Video, poses, and where the objects are."""
    folder = tmp_path_factory.mktemp("film")
    centers = film(folder / "table.avi", folder / "poses.jsonl", VIEWS)
    return folder / "table.avi", folder / "poses.jsonl", centers


def of(filmed, **values) -> Config:
    video, poses, _ = filmed
    return Config().with_values({"camera.source": str(video), "camera.poses": str(poses),
                                 "camera.intrinsics_px": list(LENS_PX)} | values)


def played(config, out) -> str:
    """Runs it; what was printed."""
    console = Console(file=io.StringIO(), width=200)
    finished = run(config, agent="sceneccn", out=out, plain=True, console=console, world="camera")
    assert finished.results == []
    draw_run(finished.folder)
    return console.file.getvalue()


def messages_of(log) -> dict:
    messages = defaultdict(list)
    for topic, part, message in RunReader(log):
        messages[topic.name, part].append(message)
    return messages


def assert_found(messages, centers, within_m=0.03) -> None:
    """Every object on the table where it is, and no other. What was never looked at, high above the table, may still
    hide the others, so they are not ruled out either."""
    beliefs = {part: found[-1] for (topic, part), found in messages.items() if topic == BELIEF.name}
    assert {name for name, belief in beliefs.items() if belief.presence > 0.5} == set(centers)
    errors = [np.linalg.norm(beliefs[name].mean_m - center) for name, center in centers.items()]
    assert max(errors) < within_m
    assert all(beliefs[name].presence > 0.95 for name in centers)


def test_every_frame_in_one_process_finds_what_is_there_and_nothing_else(filmed, tmp_path):
    text = played(of(filmed, **{"bus.kind": "local"}), tmp_path / "r")
    messages = messages_of(tmp_path / "r" / "run.mcap")
    assert_found(messages, filmed[2], within_m=0.015)
    assert [m.step for m in messages[PLAN.name, None]] == list(range(VIEWS))
    assert not {RESULT.name, TRUTH.name} & {topic for topic, _ in messages}
    assert missing(tmp_path / "r" / "run.mcap").complete
    assert "32 views\nfound cereal_box at (-0.1" in text
    assert text.count("found ") == len(filmed[2])
    assert "episode 0 step 30  search" in text
    story = read_story(tmp_path / "r" / "run.mcap")
    np.testing.assert_allclose(np.linalg.norm(story.path_m, axis=1), 0.62, atol=1e-9)
    assert Image.open(tmp_path / "r" / "picture.png").size[0] > 1000


def test_live_processes_find_the_same_whatever_they_skip(filmed, tmp_path):
    """The last frame is worked off before the run ends, the log holds every frame, and everyone says what was left
    out."""
    config = of(filmed)
    text = played(config, tmp_path / "r")
    messages = messages_of(tmp_path / "r" / "run.mcap")
    assert_found(messages, filmed[2])
    assert [m.step for m in messages[FRAME.name, None]] == list(range(VIEWS))
    plans = [m.step for m in messages[PLAN.name, None]]
    assert plans == sorted(set(plans))
    assert plans[-1] == VIEWS - 1
    assert missing(tmp_path / "r" / "run.mcap").complete
    last = {part: found[-1] for (topic, part), found in messages.items() if topic == STATUS.name}
    assert {name for name, s in last.items() if s.state == "stopped"} == {"camera", "perception", "belief", "planner"}
    assert all((s.refused, s.gaps) == (0, 0) for s in last.values())
    seen = len(messages[PERCEPT.name, "soup_can"])
    assert seen + last["perception"].skipped == VIEWS
    assert load(tmp_path / "r" / "config.json").bus.live
    assert text.count("found ") == len(filmed[2])
    assert (tmp_path / "r" / "picture.png").is_file()
    replay = prepare(tmp_path / "r" / "run.mcap", ("perception", "belief", "planner"), {}, pace=Pace())
    comparison = replay_here(replay, tmp_path / "again", Keys(enabled=False), print).comparison
    assert comparison.compared > 3 * seen
    assert (comparison.unequal, comparison.equal) == (0, True)
    with pytest.raises(SaccadeError, match="was recorded live: add --bus local"):
        replay_on_bus(replay, tmp_path / "bus", Keys(enabled=False), print)


@contextmanager
def interrupted(filmed, out, *options, **streams):
    """The command on a film without end; Ctrl-C once it has been round."""
    video, poses, _ = filmed
    process = subprocess.Popen(
        [sys.executable, "-m", "saccade", "run", "--world", "camera", "--source", video, "--poses", poses,
         "--intrinsics", ",".join(map(str, LENS_PX)), "--loop", "--plain", "--out", out, *options],
        text=True, **streams)
    try:
        end = time.monotonic() + WAIT_S
        while time.monotonic() < end and not any(
                topic == FRAME and message.step > VIEWS for topic, _, message in so_far(out / "run.mcap")):
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        yield process
    finally:
        process.kill()


def test_ctrl_c_ends_a_run_with_its_log_and_its_picture(filmed, tmp_path):
    """As it must end that of a webcam."""
    out = tmp_path / "r"
    with interrupted(filmed, out, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        text, errors = process.communicate(timeout=WAIT_S)
    assert (process.returncode, errors) == (0, "")
    assert "found coffee_can" in text
    assert (out / "picture.png").is_file()
    report = missing(out / "run.mcap")
    assert report.cut is None
    assert report.lost == {}


@pytest.mark.skipif(sys.platform == "win32", reason="a terminal of its own is POSIX's")
def test_ctrl_c_on_a_terminal_ends_a_run_that_is_looked_at_too(filmed, tmp_path):
    ours, theirs = os.openpty()
    options = ("--view", "--set", f"viewer.port={free_port('127.0.0.1')}")
    with interrupted(filmed, tmp_path / "r", *options, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        code = process.wait(WAIT_S)
    text = ""
    with open(ours, errors="replace") as terminal, suppress(OSError):  # so Linux ends a terminal
        for said in terminal:
            text += said
    assert code == 0, text
    assert "found coffee_can" in text


def test_with_a_goal_image_the_agent_says_where_it_is(filmed, tmp_path):
    """The goal is one of the film's own views, which is not to be missed."""
    import cv2

    capture = cv2.VideoCapture(str(filmed[0]))
    for _ in range(20):
        _, bgr = capture.read()
    Image.fromarray(np.ascontiguousarray(bgr[..., ::-1])).save(tmp_path / "goal.png")
    text = played(of(filmed, **{"bus.kind": "local", "scene.goal_image": str(tmp_path / "goal.png")}), tmp_path / "r")
    said = re.search(r"goal image goal\.png: the agent says at view (\d+) that it is there", text)
    assert abs(int(said[1]) - 19) <= 1
    assert "found" not in text
    messages = messages_of(tmp_path / "r" / "run.mcap")
    assert messages[GOAL.name, None][0].rgb is not None
    assert messages[PLAN.name, None][-1].target in filmed[2]


@pytest.mark.parametrize(("arguments", "words"), [
    (("--world", "moon"), "world 'moon' is unknown: choose from simulator, camera"),
    (("--world", "camera"), "camera.source is not given: give a folder of images"),
    (("--world", "camera", "--source", "none.avi"), "camera source none.avi is not there"),
    (("--source", "f"), "add `--world camera`"),
    (("--world", "camera", "--source", "f", "--intrinsics", "a,b"), "--intrinsics 'a,b': write fx,fy,cx,cy"),
    (("--world", "camera", "--source", "f", "--intrinsics", "600,600"), "camera.intrinsics_px"),
    (("--world", "camera", "--source", "f", "--rate", "0"), "camera.rate_hz"),
    (("--world", "camera", "--source", "f", "--poses", "p.txt"), "poses p.txt cannot be read"),
    (("--world", "camera", "--source", "f", "--n-objects", "2"), "scenes are the simulator's"),
    (("--world", "camera", "--source", "f", "--goal", "none.png"), "goal image"),
    (("--world", "camera", "--source", "f", "--agent", "oracle", "--bus", "local"), "must be told the truth"),
])
def test_what_the_user_can_mend_is_one_line_and_code_2(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    folder_of(tmp_path / "f", ["a.png"])
    code, _, err = call(monkeypatch, capsys, "run", *arguments)
    assert code == 2
    assert err.startswith("saccade: ")
    assert words in err
    assert err.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_images_without_a_pose_are_left_out_and_said(tmp_path):
    """And apart from them, how many messages of a bag could not be used."""
    def messages():
        for k in range(4):
            time_ns = ros.FIRST_NS + k * ros.STEP_NS
            message = ros.image(time_ns, grey(k))
            yield ros.IMAGE, time_ns, (message.__msgtype__, ros.cdr(message)[:500]) if k == 2 else message
    poses = written(tmp_path / "p.jsonl", pose_line(index=1))
    source = ros.bag(tmp_path / "f", messages())
    config = Config().with_values({"camera.source": str(source), "camera.poses": str(poses)})
    text = played(config.with_values({"bus.kind": "local"}), tmp_path / "local")
    assert "camera: camera.intrinsics_px is not given: " in text
    assert ("camera: 2 images without a pose were left out\n"
            "camera: 1 message that cannot be used was left out\n1 view\n") in text
    text = played(config, tmp_path / "bus")
    assert text.count("camera: camera.intrinsics_px is not given: ") == 1
    assert "\n1 view; 2 images without a pose were left out; 1 message that cannot be used was left out\n" in text


@pytest.mark.parametrize("bus", ["zenoh", "local"])
def test_a_camera_without_any_pose_ends_with_its_reason(tmp_path, bus):
    folder_of(tmp_path / "f", ["a.png", "b.png"])
    poses = written(tmp_path / "p.jsonl", pose_line(image="c.png"))
    config = Config().with_values({"camera.source": str(tmp_path / "f"), "camera.poses": str(poses), "bus.kind": bus})
    with pytest.raises(SaccadeError, match="none of the 2 images"):
        played(config, tmp_path / "r")


def test_a_camera_is_live_on_the_bus_and_explores_without_a_goal(tmp_path):
    config = Config().with_values({"camera.source": str(folder_of(tmp_path / "f", ["a.png"]))})
    live = [in_world(config.with_values({"bus.kind": kind}), "camera").bus.live for kind in ("zenoh", "local")]
    assert live == [True, False]
    assert in_world(config, "camera").scene.explore
    assert in_world(Config(), "simulator") == Config()


def test_the_notes_of_a_simulator_are_said_too():
    console = Console(file=io.StringIO(), width=200)
    display = Display(console, plain=True, source="simulator")
    for part, note in (("simulator", "the goal is black"), ("simulator", "the goal is black"), ("belief", "is slow")):
        display.take(STATUS, part, sample(Status, service=part, note=note))
    assert console.file.getvalue().splitlines() == ["simulator: the goal is black"]


def test_the_display_does_without_a_truth_and_says_notes_once():
    console = Console(file=io.StringIO(), width=200)
    display = Display(console, plain=True, judged=False, source="camera", live=True)
    for note in ("waits for belief", "one\ntwo", "one\ntwo", "refused: action: bad"):
        display.take(STATUS, "camera", sample(Status, service="camera", note=note))
    display.take(FRAME, None, sample(Frame, episode=0, step=10))
    display.take(PLAN, None, sample(Plan, target="", mode="search", believed_distance_m=-1.0))
    display.take(BELIEF, "mug", sample(Belief, presence=0.9))
    display.take(STATUS, "perception", sample(Status, service="perception", milliseconds=80.0, skipped=3))
    assert console.file.getvalue().splitlines() == ["camera: one", "camera: two", "episode 0 step 10"]
    assert line(display.progress).startswith("episode 0 step 10  search  G ")
    console.print(panel(display.progress))
    text = console.file.getvalue()
    assert "perception 80 ms (3 skipped)" in text
    assert "truth" not in text
