"""Scenes of several instances, of any pose, with a workspace and with events: read back as written, or refused in one
line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from saccade.services.simulator.scene import Drift, Placed
from saccade.services.simulator.scenes import load_scenes, save_scenes
from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import look_at, rotation_xyz
from saccade.shared.world.workspace import BoxReach, ShellReach

GOAL = look_at([0.3, 0.0, 0.3], [0.0, 0.0, 0.05]).tolist()
LYING = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]
CAN, SECOND = {"name": "can", "center_xyz_m": [0.1, 0.0, 0.07], "yaw_rad": 0.3}, {
    "name": "can", "instance": 2, "center_xyz_m": [-0.1, 0.0, 0.05], "quaternion_xyzw": LYING}
BOX = {"lower_xyz_m": [-1, -1, 0.1], "upper_xyz_m": [1, 1, 0.8]}
WALL = {"center_xyz_m": [0.0, 0.4, 0.2], "size_xyz_m": [0.3, 0.02, 0.4], "yaw_rad": 0.1, "rgb": [1, 2, 3]}
AT = {"center_xyz_m": [0.2, 0.2, 0.07], "yaw_rad": 0.0}
EVENTS = [{"event": "moved", "name": "can", "at_step": 4, **AT},
          {"event": "taken", "name": "can", "instance": 2, "after_in_view": 2},
          {"event": "put_back", "name": "can", "instance": 2, "after_previous": 10},
          {"event": "pushed_over", "name": "can", "at_step": 9, "center_xyz_m": [0.2, 0.2, 0.05],
           "quaternion_xyzw": LYING},
          {"event": "drifts", "name": "can", "at_step": 12, "velocity_xy_m": [0.01, -0.01], "steps": 20,
           "back_after_steps": 5},
          {"event": "drifts", "name": "can", "at_step": 40, "about_xy_m": [0.0, 0.2], "turn_rad": 0.05, "turns": False}]


def entry(**changes):
    return {"id": "a", "target": "can", "target_instance": 2, "table_rgb": [1, 2, 3], "objects": [CAN, SECOND],
            "goal_world_from_camera": GOAL, "start_world_from_camera": GOAL, "workspace": BOX,
            "table": {"size_xy_m": [1.2, 0.8], "height_m": -0.1}, "obstacles": [WALL], "events": EVENTS} | changes


def loaded(path, told):
    path.write_text(json.dumps({"scenes": [told]}))
    return load_scenes(path, ["can", "box"])[0]


def test_what_was_read_is_written_and_read_again(tmp_path):
    for workspace in (BOX, {"center_xyz_m": [0.5, 0, 0], "inner_m": 0.2, "outer_m": 0.9}):
        scene = loaded(tmp_path / "s.json", entry(workspace=workspace))
        save_scenes(tmp_path / "again.json", [scene])
        assert json.loads((tmp_path / "again.json").read_text())["scenes"][0] == entry(workspace=workspace)
        assert isinstance(scene.workspace, BoxReach if workspace is BOX else ShellReach)
    assert [p.label for p in scene.objects] == ["can", "can#2"]
    assert scene.target_placed.label == "can#2"
    np.testing.assert_allclose(scene.target_placed.rotation, rotation_xyz([0, np.pi / 2, 0]), atol=1e-12)
    assert scene.objects[0].turned == 0.3


BAD = {
    "one instance twice": ({"objects": [CAN, CAN]}, "stands in it twice"),
    "no such instance": ({"target_instance": 3}, "target 'can' is not among its objects"),
    "instance 0": ({"objects": [CAN | {"instance": 0}]}, "instance must be a whole number from 1 to 255"),
    "two poses": ({"objects": [CAN, SECOND | {"yaw_rad": 0}]}, "both given: leave one out"),
    "no pose": ({"objects": [CAN, {"name": "can", "instance": 2, "center_xyz_m": [0, 0, 0]}]}, "yaw_rad is missing"),
    "long quaternion": ({"objects": [CAN, SECOND | {"quaternion_xyzw": [1, 1, 0, 0]}]}, "must have length 1"),
    "absent and there": ({"target_absent": True}, "there are several of the target"),
    "many objects": ({"objects": [CAN] * 300}, "objects has 300 entries, more than 255"),
    "no workspace": ({"workspace": None}, "not a map"),
    "flat workspace": ({"workspace": BOX | {"upper_xyz_m": [1, 1, 0.1]}}, "at least 0.05 m above"),
    "far workspace": ({"workspace": BOX | {"upper_xyz_m": [9, 1, 0.5]}}, "upper_xyz_m must be from -3 to 3"),
    "thin shell": ({"workspace": {"center_xyz_m": [0, 0, 0], "inner_m": 0.5, "outer_m": 0.5}}, "outer_m must be"),
    "small table": ({"table": {"size_xy_m": [0.01, 1]}}, "size_xy_m must be from 0.1 to 4"),
    "many obstacles": ({"obstacles": [WALL] * 33}, "obstacles has 33 entries, more than 32"),
    "an obstacle": ({"obstacles": [WALL, {}]}, "obstacle 1: center_xyz_m is missing"),
    "unknown event": ({"events": [{"event": "explodes", "name": "can"}]}, "event 0: event must be one of moved, taken"),
    "no time": ({"events": [{"event": "taken", "name": "can"}]}, "exactly one of at_step"),
    "two times": ({"events": [EVENTS[0] | {"after_in_view": 1}]}, "exactly one of at_step"),
    "before all": ({"events": [EVENTS[2]]}, "after_previous needs an event before it"),
    "step 0": ({"events": [EVENTS[0] | {"at_step": 0}]}, "at_step must be a whole number from 1"),
    "of nothing": ({"events": [EVENTS[1] | {"instance": 7}]}, "'can#7' is not among the objects"),
    "moved nowhere": ({"events": [{"event": "moved", "name": "can", "at_step": 1}]}, "center_xyz_m is missing"),
    "fast": ({"events": [EVENTS[4] | {"velocity_xy_m": [0.02, 0.02]}]}, "more than 0.02 m a step"),
    "fast arc": ({"events": [EVENTS[5] | {"turn_rad": 0.5}]}, "more than 0.02 m a step"),
    "drifts nowhere": ({"events": [{"event": "drifts", "name": "can", "at_step": 1}]}, "say how it drifts"),
    "many events": ({"events": [EVENTS[0]] * 65}, "events has 65 entries, more than 64"),
}


@pytest.mark.parametrize(("change", "words"), BAD.values(), ids=BAD.keys())
def test_a_bad_scene_is_refused_in_one_line(tmp_path, change, words):
    with pytest.raises(SaccadeError) as caught:
        loaded(tmp_path / "s.json", entry(**change))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["start_world_from_camera", "table", "obstacles"])
def test_what_the_rule_of_the_paper_does_not_know_needs_a_workspace(tmp_path, key):
    told = {k: v for k, v in entry().items() if k not in ("start_world_from_camera", "table", "obstacles", "workspace")}
    with pytest.raises(SaccadeError, match=f"{key} needs a workspace"):
        loaded(tmp_path / "s.json", told | {key: entry()[key]})


def test_drifting():
    """Straight, to and fro, around an axis with and without turning, and not further than it should."""
    start = Placed("can", np.array([0.2, 0.0, 0.07]), 0.5)
    straight = Drift((0.01, 0.0), steps=10, back_after_steps=4)
    xs = [straight.after(start, k).center_m[0] for k in (0, 4, 6, 8, 10, 99)]
    np.testing.assert_allclose(xs, [0.2, 0.24, 0.22, 0.2, 0.22, 0.22])
    quarter = Drift(about_xy_m=(0.0, 0.0), turn_rad=np.pi / 20)
    there = quarter.after(start, 10)
    np.testing.assert_allclose(there.center_m, [0.0, 0.2, 0.07], atol=1e-12)
    assert there.yaw_rad == pytest.approx(0.5 + np.pi / 2)
    assert Drift(about_xy_m=(0.0, 0.0), turn_rad=0.1, turns=False).after(start, 9).yaw_rad == 0.5
    assert quarter.speed_m(start) == pytest.approx(0.2 * np.pi / 20)
    lying = Placed("can", start.center_m, 0.0, 1, tuple(LYING))
    np.testing.assert_allclose(quarter.after(lying, 10).rotation, rotation_xyz([0, 0, np.pi / 2]) @ lying.rotation,
                               atol=1e-9)
