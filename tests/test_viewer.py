"""What the viewer makes of messages: read back from the recording that it writes for Rerun."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from saccade.app.run.run import run
from saccade.services.viewer.core import Viewer
from saccade.services.viewer.curves import F_TERMS, G_TERMS, entropy_nats
from saccade.services.viewer.images import outline
from saccade.services.viewer.words import decision, happened, plain
from saccade.services.viewer.world import PATH_LENGTH
from saccade.shared.bus.topics import BELIEF, EVENTS, FRAME, PERCEPT, PLAN, STATUS, TRUTH
from saccade.shared.config import Config
from saccade.shared.log.reading import RunReader
from saccade.shared.world.geometry import INTRINSICS_PX, look_at
from saccade.tests.fakes.logs import story, write
from saccade.tests.fixtures.make import GOLDEN
from saccade.tests.front_door import call
from saccade.tests.samples import sample

NAMES = ("soup_can", "rice_box")


class Seen:
    """A recording: (step, values) of a component of an entity, in the order of the steps."""

    def __init__(self, path) -> None:
        self.entities: dict[str, set[str]] = defaultdict(set)
        self._rows: dict[tuple[str, str], list] = defaultdict(list)
        for chunk in RrdReader(path).stream().to_chunks():
            table = chunk.to_record_batch()
            steps = table["step"].to_pylist() if "step" in table.schema.names else [None] * table.num_rows
            for name in (name for name in table.schema.names if ":" in name):
                self.entities[chunk.entity_path].add(name)
                rows = zip(steps, table[name].to_pylist(), strict=True)
                self._rows[chunk.entity_path, name] += [row for row in rows if row[1]]

    def of(self, entity: str, component: str) -> dict:
        """The last value of each step."""
        rows = self._rows[entity, component]
        return dict(sorted(rows, key=lambda row: row[0])) if rows and rows[0][0] is not None else dict(rows)

    def numbers(self, entity: str) -> dict:
        return self.of(entity, "Scalars:scalars")

    def words(self) -> list[str]:
        return [text for _, texts in self._rows["/decisions", "TextLog:text"] for text in texts]


def saved(monkeypatch, capsys, tmp_path, log, *options) -> tuple[Seen, str]:
    """What `saccade view LOG --save` writes and says."""
    code, out, err = call(monkeypatch, capsys, "view", log, "--save", tmp_path / "run.rrd", *options)
    assert code == 0, err
    return Seen(tmp_path / "run.rrd"), out


def test_a_log_as_a_recording_has_everything_that_was_seen_believed_and_planned(monkeypatch, capsys, tmp_path):
    seen, out = saved(monkeypatch, capsys, tmp_path, GOLDEN, "--truth")
    assert out.startswith("no status: without milliseconds")  # of processes: this run was within one
    assert out.count("without") == 1
    messages = list(RunReader(GOLDEN))
    frames = [m for t, _, m in messages if t == FRAME]
    steps = [m.step for m in frames]
    assert list(seen.of("/world/camera/image", "EncodedImage:blob")) == steps
    places = seen.of("/world/camera", "Transform3D:translation")
    np.testing.assert_allclose([places[m.step][0] for m in frames], [m.world_from_camera[:3, 3] for m in frames],
                               atol=1e-6)
    beliefs = {(p, m.step): m for t, p, m in messages if t == BELIEF}
    for name in NAMES:
        clouds = seen.of(f"/world/objects/{name}/particles", "Points3D:positions")
        assert all(np.array_equal(np.float32(clouds[step]), beliefs[name, step].particles_m) for step in steps)
    for step in steps:
        of_step = [beliefs[name, step] for name in NAMES]
        np.testing.assert_allclose(seen.numbers("/entropy")[step], [entropy_nats(b) for b in of_step])
        np.testing.assert_allclose(seen.numbers("/presence")[step], [b.presence for b in of_step])
        np.testing.assert_allclose(seen.numbers("/F")[step],
                                   [sum(b.free_energy if term == "total" else getattr(b, f"f_{term}") for b in of_step)
                                    for term in F_TERMS])
    for plan in (m for t, _, m in messages if t == PLAN):
        terms = [plan.g if term == "total" else getattr(plan, f"g_{term}") for term in G_TERMS]
        np.testing.assert_allclose(seen.numbers("/G")[plan.step], terms)
        np.testing.assert_allclose(seen.of("/world/candidates", "Points3D:positions")[plan.step], plan.best_eyes_m)
    truths = {m.step: m for t, _, m in messages if t == TRUTH}
    apart = {s: np.linalg.norm((m.world_from_camera - m.goal_world_from_camera)[:3, 3]) for s, m in truths.items()}
    assert {s: v[0] for s, v in seen.numbers("/distance/true").items()} == pytest.approx(apart)
    assert {"Boxes3D:half_sizes"} <= seen.entities["/world/true"]
    assert {"Pinhole:resolution"} <= seen.entities["/world/goal"] & seen.entities["/world/viewpoint"]
    assert seen.of("/goal/image", "EncodedImage:blob")
    assert "did not reach the goal" in seen.words()[-2]


def test_where_things_truly_are_is_shown_when_asked_for(monkeypatch, capsys, tmp_path):
    seen, _ = saved(monkeypatch, capsys, tmp_path, GOLDEN)
    for entity in ("/world/true", "/world/goal"):
        assert seen.entities[entity] <= {"Clear:is_recursive"}
    assert seen.numbers("/distance/true")  # how far off says no more than that


@pytest.mark.parametrize("scene", [{"explore": True}, {"goal_image": "goal.png"}])
def test_there_is_no_true_distance_to_a_goal_that_nobody_knows(tmp_path, scene):
    recording = rr.RecordingStream("saccade")
    recording.save(tmp_path / "run.rrd")
    viewer = Viewer(recording, Config(scene={"names": NAMES, **scene}), truth=True, live=False)
    viewer.take(TRUTH, None, sample(TRUTH.type, run="r", episode=0, step=0))
    viewer.close()
    recording.disconnect()
    seen = Seen(tmp_path / "run.rrd")
    assert "/world/true" in seen.entities
    assert not seen.numbers("/distance/true")


@pytest.mark.parametrize("moved_by", ["hand", "agent"])
def test_a_hand_sees_on_the_image_where_to_go(tmp_path, moved_by):
    recording = rr.RecordingStream("saccade")
    recording.save(tmp_path / "run.rrd")
    viewer = Viewer(recording, Config(scene={"names": NAMES}, planner={"moved_by": moved_by}), truth=False, live=False)
    at = {"run": "r", "episode": 0}
    camera, aim = look_at((0.4, 0.0, 0.3), np.zeros(3)), look_at((0.4, 0.0, 0.3), np.zeros(3))
    aim[1, 3] += 0.08
    frame = sample(FRAME.type, **at, step=0, rgb=np.zeros((480, 480, 3), np.uint8), world_from_camera=camera,
                   intrinsics_px=np.array(INTRINSICS_PX))
    viewer.take(FRAME, None, frame)
    viewer.take(PLAN, None, sample(PLAN.type, **at, step=0, viewpoint=aim, look_at_m=np.zeros(3), arrived=False))
    viewer.take(FRAME, None, replace(frame, step=1))
    viewer.close()
    recording.disconnect()
    seen = Seen(tmp_path / "run.rrd")
    words = {1: ["move 8 cm to the right"]} if moved_by == "hand" else {}
    assert seen.of("/world/camera/image/guidance/ghost", "LineStrips2D:labels") == words
    arrows = seen.of("/world/camera/image/guidance/arrow", "LineStrips2D:strips")
    assert [len(strips[0]) for strips in arrows.values()] == [8] * len(words)


def test_an_object_that_is_seen_has_box_mask_crop_and_reconstruction(monkeypatch, capsys, tmp_path):
    """Pictures of the network's own: a rice box is drawn where it is seen, and where the camera is going."""
    run(Config().with_values({"bus.kind": "local", "seed": 4, "simulator.max_steps": 8}), agent="sceneccn",
        out=tmp_path / "run", plain=True)
    percepts = [m for t, _, m in RunReader(tmp_path / "run" / "run.mcap") if t == PERCEPT]
    sure = max(percepts, key=lambda m: (m.presence, m.mask().sum()))
    seen, _ = saved(monkeypatch, capsys, tmp_path, tmp_path / "run")
    base = f"/world/camera/image/{sure.object}"
    ring = np.array(seen.of(f"{base}/box", "LineStrips2D:strips")[sure.step][0])
    assert len(ring) == 5
    assert np.allclose(ring[0], ring[4])
    assert (ring.min(0) < sure.pixel).all()
    assert (sure.pixel < ring.max(0)).all()
    assert seen.of(f"{base}/box", "LineStrips2D:labels")[sure.step] == [f"{plain(sure.object)} {sure.presence:.2f}"]
    edges = np.array(seen.of(f"{base}/mask", "LineStrips2D:strips")[sure.step])
    rows, columns = np.nonzero(sure.mask())
    cell = 480 / len(sure.mask())
    assert np.allclose(edges.reshape(-1, 2).min(0), [columns.min() * cell, rows.min() * cell])
    assert np.allclose(edges.reshape(-1, 2).max(0), [(columns.max() + 1) * cell, (rows.max() + 1) * cell])
    assert sure.step in seen.of("/crops/image", "EncodedImage:blob")
    assert seen.of("/world/viewpoint/imagined", "EncodedImage:blob")
    assert len(seen.of("/crops/names", "Points2D:labels")[None]) == 5


def test_episodes_follow_one_another_and_each_begins_empty(monkeypatch, capsys, tmp_path):
    log = write(tmp_path / "run.mcap", story(episodes=2, steps=3), configuration=json.dumps(
        {"scene": {"names": ["mug", "can"]}}))
    seen, out = saved(monkeypatch, capsys, tmp_path, log)
    assert "object 'mug' has no weights" in out
    assert list(seen.of("/world/camera/image", "EncodedImage:blob")) == [0, 1, 2, 4, 5, 6]
    assert 4 in seen.of("/world/objects", "Clear:is_recursive")
    assert len(seen.of("/world/path", "LineStrips3D:strips")[4][0]) == 1


def test_a_log_that_lacks_topics_shows_what_it_has_and_says_what_it_lacks(monkeypatch, capsys, tmp_path):
    log = write(tmp_path / "run.mcap", (m for m in story() if m[0] not in (PERCEPT, PLAN)))
    seen, out = saved(monkeypatch, capsys, tmp_path, log)
    assert "no percept: without boxes, masks and crops" in out
    assert "no plan: without candidates, viewpoints, G and decisions" in out
    assert "no belief" not in out
    assert any("no plan" in text for text in seen.words())
    assert seen.of("/world/objects/mug/particles", "Points3D:positions")
    assert seen.of("/world/camera/image", "EncodedImage:blob")


def unseen(step):
    return sample(PERCEPT.type, run="r", episode=0, step=step, object=NAMES[0], presence=0.0)


def test_what_is_seen_stands_on_the_image_it_was_seen_in(monkeypatch, tmp_path):
    """A camera does not wait: perception leaves images out, and is behind it, as beliefs are behind perception."""
    recording, drawn = rr.RecordingStream("saccade"), []
    recording.save(tmp_path / "run.rrd")
    viewer = Viewer(recording, Config(scene={"names": NAMES[:1]}), truth=False, live=False)
    monkeypatch.setattr("saccade.services.viewer.core.Images.step", lambda self, frame, percepts: drawn.append(
        (frame.step, {percept.step for percept in percepts.values()})))
    told = [("frame", 0), ("frame", 1), ("percept", 0), ("frame", 2), ("frame", 3), ("belief", 0), ("percept", 2),
            ("percept", 4), ("frame", 4), ("belief", 2), ("frame", 5), ("frame", 6), ("percept", 6)]
    messages = {"frame": lambda step: (FRAME, None, sample(FRAME.type, run="r", episode=0, step=step)),
                "percept": lambda step: (PERCEPT, NAMES[0], unseen(step)),
                "belief": lambda step: (BELIEF, NAMES[0], sample(BELIEF.type, run="r", episode=0, step=step,
                                                                 object=NAMES[0], presence=step / 10))}
    for topic, step in told:
        viewer.take(*messages[topic](step))
    viewer.close()
    recording.disconnect()
    seen = Seen(tmp_path / "run.rrd")
    assert list(seen.of("/world/camera/image", "EncodedImage:blob")) == [0, 2, 4, 6]
    assert drawn == [(0, {0}), (2, {2}), (6, {6})]
    assert {step: values[0] for step, values in seen.numbers("/presence").items()} == {0: 0.0, 2: 0.2}


def test_live_crops_are_drawn_now_and_then_only(monkeypatch, tmp_path):
    """A browser is sent something twice a second: ten steps a second need not all be drawn."""
    recording, now_s = rr.RecordingStream("saccade"), 0.0
    recording.save(tmp_path / "run.rrd")
    monkeypatch.setattr("saccade.services.viewer.core.time", SimpleNamespace(monotonic=lambda: now_s))
    viewer = Viewer(recording, Config(scene={"names": NAMES}), truth=False, live=True)
    for step in range(12):
        viewer.take(FRAME, None, sample(FRAME.type, run="r", episode=0, step=step))
        viewer.take(PERCEPT, NAMES[0], unseen(step))
        now_s += 0.125
    viewer.close()
    recording.disconnect()
    assert list(Seen(tmp_path / "run.rrd").of("/crops/image", "EncodedImage:blob")) == [0, 4, 8]


def test_what_is_kept_of_a_step_does_not_grow_with_the_run(tmp_path):
    recording = rr.RecordingStream("saccade")
    recording.save(tmp_path / "run.rrd")
    viewer, frame = Viewer(recording, Config(), truth=False, live=True), sample(FRAME.type, run="r", episode=0)
    for step in range(PATH_LENGTH + 100):
        camera = look_at((0.5, 0.0, 0.1 + step / 1e4), (0.0, 0.0, 0.0))
        viewer.take(FRAME, None, replace(frame, step=step, seq=step, world_from_camera=camera))
    viewer.take(STATUS, "planner", sample(STATUS.type, service="planner", milliseconds=7.5))
    viewer.close()
    recording.disconnect()
    seen = Seen(tmp_path / "run.rrd")
    assert list(seen.numbers("/milliseconds/planner")) == [PATH_LENGTH + 99]
    paths = seen.of("/world/path", "LineStrips3D:strips")
    assert [len(paths[step][0]) for step in (0, 9, PATH_LENGTH, PATH_LENGTH + 99)] == [1, 10, PATH_LENGTH, PATH_LENGTH]
    assert np.allclose(paths[PATH_LENGTH + 99][0][-1], camera[:3, 3], atol=1e-6)


@pytest.mark.parametrize(("changes", "presence", "words"), [
    ({"arrived": True}, 0.9, "arrived at the goal's view"),
    ({"mode": "search", "target": ""}, 0.1, "explore: tomato soup can unseen"),
    ({"mode": "search", "target": "mug"}, 0.1, "look for the mug: tomato soup can unseen"),
    ({"mode": "search", "target": ""}, 0.9, "explore: all are seen, but their positions are uncertain"),
    ({"mode": "approach"}, 0.9, "approach the mug: the goal's viewpoint is not known yet"),
    ({"mode": "goal", "believed_distance_m": 0.3}, 0.9, "approach: the goal's view of the mug"),
    ({"mode": "goal", "believed_distance_m": 0.05}, 0.9, "centre the mug as in the goal")])
def test_decisions_in_words(changes, presence, words):
    plan = sample(PLAN.type, **{"arrived": False, "target": "mug"} | changes)
    assert decision(plan, [sample(BELIEF.type, object="005_tomato_soup_can", presence=presence)]) == words


def test_events_in_words_and_as_marks(tmp_path):
    """Each event is one line among the decisions, and a mark with its name in the world."""
    events = sample(EVENTS.type, run="r", episode=0, step=3, objects=["005_tomato_soup_can", "mug"],
                    instances=np.array([2, 1], np.uint8), kinds=["moved", "gone"],
                    positions_m=np.array([[0.1, 0.2, 0.05], [0.0, 0.0, 0.1]]),
                    probabilities=np.array([0.97, 1.0]))
    said = ["the tomato soup can#2 was moved (97 %)", "the mug is gone (100 %)"]
    assert happened(events) == said
    recording = rr.RecordingStream("saccade")
    recording.save(tmp_path / "run.rrd")
    viewer = Viewer(recording, Config(), truth=False, live=False)
    viewer.take(EVENTS, None, events)
    viewer.close()
    recording.disconnect()
    seen = Seen(tmp_path / "run.rrd")
    assert seen.words()[:2] == said
    np.testing.assert_allclose(seen.of("/world/events", "Points3D:positions")[3], events.positions_m, atol=1e-6)


def test_an_outline_goes_round_the_cells():
    mask = np.zeros((4, 4), bool)
    mask[0, 1] = mask[3, 3] = True
    lines = {tuple(map(tuple, line)) for line in outline(mask)}
    assert lines == {((1, 0), (2, 0)), ((1, 1), (2, 1)), ((1, 0), (1, 1)), ((2, 0), (2, 1)),
                     ((3, 3), (4, 3)), ((3, 4), (4, 4)), ((3, 3), (3, 4)), ((4, 3), (4, 4))}


@pytest.mark.parametrize(("arguments", "complaint"), [
    ((), "give the log of a run, or --live for one that goes on"),
    ((GOLDEN, "--live"), "give the log of a run, or --live"),
    (("--live", "--save", "x.rrd"), "--save is for a log"),
    ((GOLDEN, "--run", "runs/x"), "--run and --endpoint are for a run that goes on"),
    (("nowhere.mcap",), "nowhere.mcap cannot be read (No such file or directory): give the run.mcap of a run"),
    ((__file__,), "test_viewer.py is not an MCAP file"),
    (("--live", "--run", "nowhere"), "configuration nowhere/config.json cannot be read"),
    ((GOLDEN, "--save", GOLDEN), "is there already: name a new place")])
def test_what_cannot_be_viewed_is_said_in_one_line(monkeypatch, capsys, tmp_path, arguments, complaint):
    code, _, err = call(monkeypatch, capsys, "view", *arguments)
    assert (code, err.count("\n")) == (2, 1)
    assert complaint in err
