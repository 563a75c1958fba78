"""Suites: the same scenes at every call, as many as promised, and none of the development split in any other."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from saccade.app.bench.suites import default_suite, suite_file
from saccade.services.simulator.scenes import PAPER_SCENES, load_scenes, overlapping
from saccade.services.simulator.suites import SUITES
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError

SIZES = {"can": (0.10, 0.10, 0.14), "box": (0.07, 0.16, 0.21), "carton": (0.05, 0.09, 0.18), "tin": (0.07, 0.07, 0.10),
         "bottle": (0.10, 0.07, 0.19)}
DRAWN = [name for name, suite in SUITES.items() if suite.draw]


def scenes_of(name, seed=0):
    return SUITES[name].draw(SIZES, seed)


def plain(scene) -> str:
    """What makes a scene another one."""
    places = [(p.name, p.center_m.tolist(), p.yaw_rad) for p in scene.objects]
    return json.dumps([scene.target, places, scene.goal_world_from_camera.tolist()])


@pytest.mark.parametrize(("name", "count"), [("yaw-500", 500), ("lexa-room", 100), ("dev", 100), ("paper-like", 500)])
def test_sizes(name, count):
    """Every target equally often; ids are unique; nothing overlaps."""
    scenes = scenes_of(name)
    assert len({scene.id for scene in scenes}) == len(scenes) == count
    assert Counter(scene.target for scene in scenes) == dict.fromkeys(SIZES, count // 5)
    counts = Counter(len(scene.objects) for scene in scenes)
    assert counts == ({5: 100} if name == "lexa-room" else dict.fromkeys(range(1, 6), count // 5))
    assert not any(overlapping(scene, SIZES) for scene in scenes)


@pytest.mark.parametrize("name", DRAWN)
def test_the_same_scenes_at_every_call(name):
    assert [plain(s) for s in scenes_of(name)] == [plain(s) for s in scenes_of(name)]


def test_the_seed_of_the_run_changes_only_what_is_drawn_from_it():
    changed = {name for name in DRAWN if plain(scenes_of(name, 1)[0]) != plain(scenes_of(name, 0)[0])}
    assert changed == {"paper-like", "paper-like-yaw"}


def test_dev_shares_no_scene_with_another_suite():
    dev = {plain(scene) for scene in scenes_of("dev")}
    goals = {scene.goal_world_from_camera.tobytes() for scene in scenes_of("dev")}
    for name in DRAWN:
        if name != "dev":
            assert not dev & {plain(scene) for scene in scenes_of(name)}, name
            assert not goals & {scene.goal_world_from_camera.tobytes() for scene in scenes_of(name)}, name
    assert not goals & {scene.goal_world_from_camera.tobytes() for scene in load_scenes(PAPER_SCENES)}


def test_yaws():
    """All turned, none, or half of the scenes."""
    def turned(name):
        return np.mean([any(p.yaw_rad != 0 for p in scene.objects) for scene in scenes_of(name)])

    assert {name: turned(name) for name in DRAWN} == {"yaw-500": 1, "lexa-room": 0, "looks": 1, "dev": 0.5,
                                                      "paper-like": 0, "paper-like-yaw": 1}


def test_the_room_stays_as_it_is():
    """One table, 100 goals."""
    scenes = scenes_of("lexa-room")
    assert [scene.id for scene in scenes[:2]] == ["lexa-0", "lexa-1"]
    assert len({(scene.table_rgb, tuple(p.center_m.tobytes() for p in scene.objects)) for scene in scenes}) == 1
    assert len({scene.goal_world_from_camera.tobytes() for scene in scenes}) == 100


def test_a_suite_is_written_to_a_file_that_is_read_back(tmp_path):
    """For the objects in use; the paper's own is where it was, and of its objects alone."""
    config = Config().with_values({"scene.names": ["coffee_can", "soup_can"]})
    path = suite_file("dev", config, tmp_path / "s.json")
    assert path == tmp_path / "s.json"
    assert len(load_scenes(path, config.scene.names)) == 2 * 2 * 4
    first = path.read_bytes()
    assert suite_file("dev", config, path).read_bytes() == first
    assert (default_suite("ycb"), default_suite("pantry")) == ("paper-500", "paper-like")
    assert suite_file("paper-500", Config(scene={"objects": "ycb"}), tmp_path / "none.json") == PAPER_SCENES
    assert not (tmp_path / "none.json").exists()
    with pytest.raises(SaccadeError, match=r"'paper-500' is of the objects 'ycb': .* or choose from yaw-500"):
        suite_file("paper-500", config, tmp_path / "none.json")


def test_of_a_large_set_at_most_five_objects_stand_on_a_table():
    many = {f"{name}{n}": size for name, size in SIZES.items() for n in range(3)}
    scenes = SUITES["paper-like"].draw(many, 0)
    assert Counter(len(scene.objects) for scene in scenes) == dict.fromkeys(range(1, 6), 15 * 20)
    assert {scene.target for scene in scenes} == set(many)
