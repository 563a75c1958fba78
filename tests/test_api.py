"""Saccade from Python: the same runs, logs and actions as by the command line."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

import saccade
from saccade.app.api import keys_of
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RunLog
from saccade.shared.world.geometry import INTRINSICS_PX
from saccade.shared.world.task import start_pose
from saccade.tests.fixtures.make import GOLDEN

VALUES = {"objects": "pantry", "names": ("soup_can", "rice_box"), "seed": 4}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return saccade.run(**VALUES, n_objects=2, max_steps=30, bus="local", out=tmp_path_factory.mktemp("runs") / "r")


def test_a_run_has_its_result_its_folder_and_its_configuration(run):
    assert (run.result.run, run.result.episode, run.result.objects) == ("r", 0, 2)
    assert run.results == (run.result,)
    assert {path.name for path in run.path.iterdir()} == {"run.mcap", "config.json", "picture.png"}
    assert (run.config.seed, run.config.simulator.max_steps, run.config.bus.kind) == (4, 30, "local")
    assert run.open().objects == ("soup_can", "rice_box")


def test_a_log_is_episodes_of_steps(run):
    episodes = list(run.open())
    assert [episode.number for episode in episodes] == [0]
    with pytest.raises(saccade.SaccadeError, match=r"steps of episode 0 were passed over"):
        list(episodes[0])
    for episode in saccade.open(run.path / "run.mcap"):
        assert episode.goal.rgb.shape == (480, 480, 3)
        assert set(episode.goal_percepts) == {"soup_can", "rice_box"}
        steps = list(episode)
        assert [step.number for step in steps] == list(range(run.result.steps + 1))
        for step in steps[:-1]:
            assert step.frame.rgb.shape == (480, 480, 3)
            assert set(step.percepts) == set(step.beliefs) == {"soup_can", "rice_box"}
            said = (step.plan, step.action, step.truth, *step.percepts.values(), *step.beliefs.values())
            assert {message.step for message in said} == {step.number}
        assert (steps[-1].frame, steps[-1].truth.done) == (None, True)  # no image follows the last action
        assert episode.result == run.result


def test_a_result_that_is_asked_for_first_passes_over_the_steps(run):
    log = run.open()
    for episode in log:
        assert episode.result == run.result
        with pytest.raises(saccade.SaccadeError, match=r"steps of episode 0 were passed over, and a log is read once"):
            list(episode)
        with pytest.raises(saccade.SaccadeError, match=r"were passed over"):  # also when it is tried again
            list(episode)
    for episode in log:  # the file is read again
        first = next(iter(episode))
        assert [first.number, *(step.number for step in episode)] == list(range(run.result.steps + 1))
        with pytest.raises(saccade.SaccadeError, match=r"the steps of episode 0 have been read already"):
            list(episode)
        assert episode.result == run.result


def test_logs_of_every_format_read(tmp_path):
    for path in (GOLDEN, *(GOLDEN.with_name(f"format_{number}.mcap") for number in (1, 2, 3))):
        for episode in saccade.open(path):
            steps = list(episode)
            assert steps[0].frame is not None, path
            assert steps[0].beliefs, path
            assert [step.number for step in steps] == sorted(step.number for step in steps)


def test_messages_that_a_restarted_recorder_logged_late_are_in_their_step(run, tmp_path):
    """Also what is no message is passed over."""
    late, kept = [], []
    reader = RunReader(run.path / "run.mcap")
    for entry in reader.entries():
        (late if entry.topic.name == "percept" and len(late) < 10 else kept).append(entry)
    with closing(RunLog(tmp_path / "run.mcap", world="table", metadata=reader.metadata)) as log:
        for entry in [*kept[:-1], *late, kept[-1]]:
            log.write(entry.topic, entry.part, entry.payload)
        log.write(late[0].topic, late[0].part, b"\xc1")
    episode = next(iter(saccade.open(tmp_path)))
    assert [sorted(step.percepts) for step in episode][:3] == [["rice_box", "soup_can"]] * 3


def test_an_agent_does_what_the_run_did(run):
    """The same images and poses give the same actions, to the byte."""
    episode = next(iter(run.open()))
    agent = saccade.Agent(**VALUES, goal=episode.goal.rgb)
    for step in episode:
        if step.frame is None:
            break
        action = agent.step(step.frame.rgb, step.frame.world_from_camera)
        assert np.array_equal(action.translation_m, step.action.translation_m), step
        assert np.array_equal(action.rotation_rad, step.action.rotation_rad), step
        assert np.array_equal(agent.beliefs["soup_can"].mean_m, step.beliefs["soup_can"].mean_m)
        assert agent.plan.target == step.plan.target
        after = saccade.apply_action(step.frame.world_from_camera, action.translation_m, action.rotation_rad)
    assert after.shape == (4, 4)


def test_an_agent_begins_anew(run):
    episode = next(iter(run.open()))
    first = next(iter(episode)).frame
    agent = saccade.Agent(**VALUES)
    before = agent.step(first.rgb, first.world_from_camera)
    assert (agent.plan.mode, agent.plan.target) == ("search", "")  # without a goal it explores
    agent.reset(goal=episode.goal.rgb)
    assert agent.beliefs == {}
    assert agent.step(first.rgb, first.world_from_camera).episode == before.episode + 1
    assert agent.goal_percepts["soup_can"].presence != agent.goal_percepts["rice_box"].presence


def test_an_agent_takes_images_of_other_cameras(run):
    """One of twice the resolution sees the same."""
    frame = next(iter(next(iter(run.open())))).frame
    fine = np.repeat(np.repeat(frame.rgb, 2, axis=0), 2, axis=1)
    agents = [saccade.Agent(**VALUES) for _ in range(2)]
    agents[0].step(frame.rgb, frame.world_from_camera)
    agents[1].step(fine, frame.world_from_camera, intrinsics=[2 * x for x in INTRINSICS_PX])
    for name in ("soup_can", "rice_box"):
        assert np.allclose(agents[0].percepts[name].pixel, agents[1].percepts[name].pixel, atol=1.0)


@pytest.mark.parametrize(("change", "words"), [
    ({"rgb": np.zeros((480, 480), np.uint8)}, r"image of shape \[480, 480\]"),
    ({"rgb": np.zeros((480, 480, 3))}, "type float64"),
    ({"world_from_camera": np.eye(3)}, "give 4x4"),
    ({"world_from_camera": np.diag([1.0, 1.0, np.nan, 1.0])}, "finite"),
    ({"world_from_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rotation"),
    ({"world_from_camera": start_pose().T}, "does not end in the row 0 0 0 1: is it transposed?"),
    ({"world_from_camera": "x"}, "world_from_camera is 'x': give 4x4 finite numbers"),
    ({"world_from_camera": [[1, 0], [0]]}, "give 4x4 finite numbers"),
    ({"rgb": [[1, 0], [0]]}, "image is no array of numbers"),
    ({"intrinsics": (1, 2)}, r"intrinsics \(1, 2\) are not four numbers: give fx, fy, cx, cy"),
    ({"intrinsics": "abc"}, "intrinsics 'abc' are not four numbers"),
])
def test_what_an_agent_cannot_use_is_told(change, words):
    given = {"rgb": np.zeros((480, 480, 3), np.uint8), "world_from_camera": np.eye(4)} | change
    with pytest.raises(saccade.SaccadeError, match=words):
        saccade.Agent(**VALUES).step(**given)


@pytest.mark.parametrize(("given", "words"), [
    ((start_pose(), [0, 0], [0, 0, 0]), r"translation_m of shape \[2\]: give 3 finite numbers"),
    ((np.eye(3), [0, 0, 0], [0, 0, 0]), r"world_from_camera of shape \[3, 3\]"),
    ((start_pose(), [0, 0, 0], [0, 0, np.nan]), "rotation_rad is not finite: give 3 finite numbers"),
    ((start_pose(), "x", [0, 0, 0]), "translation_m is 'x'"),
])
def test_an_action_that_is_none_is_told(given, words):
    with pytest.raises(saccade.SaccadeError, match=words):
        saccade.apply_action(*given)


@pytest.mark.parametrize(("call", "words"), [
    (lambda: saccade.open(3), "the log is 3: give a path as a text"),
    (lambda: saccade.open(None), "the log is None: give a path"),
    (lambda: saccade.run(out=3), "out is 3: give a path"),
    (lambda: saccade.run(config={"seed": 1}), r"config is \{'seed': 1\}: give a path"),
    (lambda: saccade.Agent(config=3), "config is 3: give a path"),
    (lambda: saccade.run(source="images"), "or world='camera' in Python"),
])
def test_what_is_no_path_is_told(call, words):
    with pytest.raises(saccade.SaccadeError, match=words):
        call()


def test_keywords_are_keys_of_the_configuration():
    assert keys_of({"seed": 1, "objects": "ycb", "step_m": 0.1, "bus": "local", "names": ("a",)}) == {
        "seed": 1, "scene.objects": "ycb", "planner.step_m": 0.1, "bus.kind": "local", "scene.names": ["a"]}
    assert keys_of({"planner": {"candidates": 5}, "bus": {"kind": "zenoh"}}) == {
        "planner.candidates": 5, "bus.kind": "zenoh"}
    with pytest.raises(saccade.SaccadeError, match="'steps' is no key of the configuration: the guide's page 'Conf"):
        keys_of({"steps": 1})
    assert keys_of({"scenes": "a.json", "intrinsics": (1, 2, 3, 4), "rate": 5}) == {  # as the options are called
        "scene.file": "a.json", "camera.intrinsics_px": [1, 2, 3, 4], "camera.rate_hz": 5}
    assert keys_of({"source": "images", "planner": "my_planner"}) == {
        "camera.source": "images", "services.planner": "my_planner"}
    with pytest.raises(saccade.SaccadeError, match=r"'planner\.step' is unknown"):
        saccade.run(planner={"step": 1})


def test_a_keyword_that_could_mean_two_keys_is_told(monkeypatch):
    monkeypatch.setattr("saccade.app.api._leaves", lambda: {"pace": ("camera.pace", "bus.pace")})
    with pytest.raises(saccade.SaccadeError, match=r"could be camera\.pace or bus\.pace: give a section"):
        keys_of({"pace": 1})


def test_the_package_tells_what_it_has():
    assert set(saccade.__all__) < set(dir(saccade))
    assert saccade.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        saccade.walk  # noqa: B018
