"""Scenes: what is read back, what is refused and with which words, and what the generator guarantees."""

from __future__ import annotations

import json

import numpy as np
import pytest

from saccade.services.simulator import scenes as scenes_module
from saccade.services.simulator.scenes import (
    PAPER_SCENES,
    generate_scene,
    generate_split,
    load_scenes,
    overlapping,
    save_scenes,
)
from saccade.shared.errors import SaccadeError
from saccade.shared.files import MAX_VALUES
from saccade.shared.render.objects import YCB_NAMES
from saccade.shared.world.geometry import rotation_angle, rotation_towards
from saccade.shared.world.task import LOWER_M, UPPER_M, spheres_around

SIZES = {"can": (0.10, 0.10, 0.14), "box": (0.07, 0.16, 0.21), "carton": (0.05, 0.09, 0.18), "tin": (0.07, 0.07, 0.10),
         "bottle": (0.10, 0.07, 0.19)}


def entry(**changes):
    """A good scene, changed."""
    goal = [[1, 0, 0, 0.1], [0, 1, 0, 0.0], [0, 0, 1, 0.4], [0, 0, 0, 1]]
    objects = [{"name": "can", "center_xyz_m": [0.1, 0.0, 0.07], "yaw_rad": 0.3}]
    return {"id": "a", "target": "can", "table_rgb": [1, 2, 3], "objects": objects,
            "goal_world_from_camera": goal} | changes


def write(path, *entries):
    path.write_text(json.dumps({"scenes": list(entries)}))
    return path


def test_a_good_scene_is_read(tmp_path):
    scene, = load_scenes(write(tmp_path / "s.json", entry()), ["can"])
    assert (scene.id, scene.target, scene.table_rgb) == ("a", "can", (1, 2, 3))
    assert scene.on_table == scene.objects
    assert scene.target_placed.yaw_rad == 0.3
    assert scene.goal_world_from_camera.dtype == np.float64


def test_the_paper_scenes_are_5_targets_by_5_counts_by_20():
    scenes = load_scenes(PAPER_SCENES, YCB_NAMES)
    assert len(scenes) == 500
    for target in YCB_NAMES:
        counts = [len(scene.objects) for scene in scenes if scene.target == target]
        assert [counts.count(n) for n in range(1, 6)] == [20] * 5
    assert all(placed.yaw_rad == 0 for scene in scenes for placed in scene.objects)


def placed(**changes):
    return [{"name": "can", "center_xyz_m": [0.1, 0.0, 0.07], "yaw_rad": 0.3} | changes]


BAD = {
    "no id": (entry(id=""), "id must be a text"),
    "unknown key": (entry(colour=1), "colour is unknown"),
    "not a map": ([1], "not a map"),
    "no objects": (entry(objects=[]), "at least one object"),
    "unknown object": (entry(objects=placed(name="dog"), target="dog"), "'dog' is not in use"),
    "twice": (entry(objects=placed() * 2), "stands in it twice"),
    "target absent": (entry(target="box"), "not among its objects"),
    "short centre": (entry(objects=placed(center_xyz_m=[0.1, 0.2])), "center_xyz_m must be numbers of shape"),
    "text yaw": (entry(objects=placed(yaw_rad="left")), "yaw_rad must be numbers"),
    "not finite": (entry(objects=placed(center_xyz_m=[0.1, float("nan"), 0])), "center_xyz_m is not finite"),
    "ragged goal": (entry(goal_world_from_camera=[[1, 0], [0]]), "goal_world_from_camera must be numbers"),
    "no rotation": (entry(goal_world_from_camera=(2 * np.eye(4)).tolist()), "not a rigid transform"),
    "mirrored": (entry(goal_world_from_camera=np.diag([1, 1, -1, 1]).tolist()), "not a rigid transform"),
    "colour": (entry(table_rgb=[0, 0, 256]), "table_rgb"),
    "far": (entry(objects=placed(center_xyz_m=[1e300, 0, 0])), "center_xyz_m must be within ±10"),
    "whole and far": (entry(objects=placed(center_xyz_m=[10 ** 400, 0, 0])), "center_xyz_m is larger"),
    "far goal": (entry(goal_world_from_camera=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 99], [0, 0, 0, 1]]),
                 "goal_world_from_camera must be within"),
    "yaw": (entry(objects=placed(yaw_rad=1e30)), "yaw_rad must be within"),
    "bool": (entry(objects=placed(center_xyz_m=[True, 0.5, 0])), "center_xyz_m must be numbers of shape"),
    "texts": (entry(objects=placed(center_xyz_m=["x" * 10 ** 6, "y", "z"])), "center_xyz_m must be numbers of shape"),
    "many": (entry(table_rgb=[1] * 10 ** 5), "table_rgb must be numbers of shape"),
    "long id": (entry(id="x" * 5000), "id has 5000 characters: shorten it to 256"),
    "control codes": (entry(id="\x1b[31mred\n"), "'\\x1b[31mred\\n': id must be Unicode without control codes"),
    "half a character": (entry(id="\ud800"), "'\\ud800': id must be Unicode"),
    "long name": (entry(objects=placed(name="x" * 300)), "name has 300 characters"),
    "id is a map": (entry(id={"a": [[[[[[[[1]]]]]]]]}), "id must be a text"),
    "target is a list": (entry(target=[[["can"]]]), "not among its objects"),
    "flag": (entry(target_absent="yes"), "target_absent must be"),
}


@pytest.mark.parametrize(("bad", "words"), BAD.values(), ids=BAD.keys())
def test_a_bad_scene_is_refused_in_one_line(tmp_path, bad, words):
    path = write(tmp_path / "s.json", bad)
    with pytest.raises(SaccadeError) as caught:
        load_scenes(path, ["can", "box"])
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["id", "target", "table_rgb", "objects", "goal_world_from_camera"])
def test_a_missing_key_is_named(tmp_path, key):
    bad = entry()
    del bad[key]
    with pytest.raises(SaccadeError, match=f"{key} is missing"):
        load_scenes(write(tmp_path / "s.json", bad))


def test_ids_must_be_unique(tmp_path):
    with pytest.raises(SaccadeError, match="occurs twice"):
        load_scenes(write(tmp_path / "s.json", entry(), entry()))


@pytest.mark.parametrize("text", ["{", "[]", '{"scenes": []}', '{"scenes": 3}', "\xff"])
def test_a_damaged_file_is_refused(tmp_path, text):
    path = tmp_path / "s.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(SaccadeError, match=str(path)):
        load_scenes(path)


def test_a_deep_file_or_one_that_says_a_key_twice_is_refused(tmp_path):
    for text, words in (('{"scenes": ' + "[" * 10 ** 5, "nested deeper"),
                        ('{"scenes": [{"id": "a", "id": "b"}]}', "key 'id' is there twice")):
        (tmp_path / "s.json").write_text(text)
        with pytest.raises(SaccadeError, match=words):
            load_scenes(tmp_path / "s.json")


def test_a_large_file_is_refused_by_its_size_and_then_by_its_numbers(tmp_path, monkeypatch):
    """A file of 1 GB took a minute and 6 GB before it was refused."""
    with (tmp_path / "s.json").open("wb") as file:
        file.truncate(2 ** 40)
    with pytest.raises(SaccadeError, match="is larger than 64 MiB"):
        load_scenes(tmp_path / "s.json")
    (tmp_path / "s.json").write_text('{"scenes": [' + "{}," * (MAX_VALUES + 1) + "{}]}")
    with pytest.raises(SaccadeError, match="holds more than 4000000 values"):
        load_scenes(tmp_path / "s.json")
    monkeypatch.setattr(scenes_module, "MAX_SCENES", 1)
    with pytest.raises(SaccadeError, match="holds 2 scenes, more than 1"):
        load_scenes(write(tmp_path / "s.json", entry(), entry(id="b")))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SaccadeError, match=r"nowhere\.json cannot be read"):
        load_scenes(tmp_path / "nowhere.json")


def test_an_absent_target_is_in_the_goal_only(tmp_path):
    objects = [*placed(), {"name": "box", "center_xyz_m": [-0.1, 0, 0.1], "yaw_rad": 0}]
    scene, = load_scenes(write(tmp_path / "s.json", entry(objects=objects, target_absent=True)))
    assert [p.name for p in scene.on_table] == ["box"]
    assert scene.target_placed.name == "can"


def test_saved_scenes_are_read_back_exactly(tmp_path):
    scenes = generate_split(SIZES, seed=3, repeats=2)
    save_scenes(tmp_path / "s.json", scenes)
    back = load_scenes(tmp_path / "s.json", list(SIZES))
    for a, b in zip(scenes, back, strict=True):
        assert (a.id, a.target, a.table_rgb, a.target_absent) == (b.id, b.target, b.table_rgb, b.target_absent)
        np.testing.assert_array_equal(a.goal_world_from_camera, b.goal_world_from_camera)
        for p, q in zip(a.objects, b.objects, strict=True):
            assert (p.name, p.yaw_rad, p.center_m.tolist()) == (q.name, q.yaw_rad, q.center_m.tolist())


def test_a_split_is_deterministic_and_covers_targets_and_counts():
    a, b, other = (generate_split(SIZES, seed=seed, repeats=3) for seed in (5, 5, 6))
    assert [s.id for s in a] == [s.id for s in b]
    assert len({s.id for s in a}) == len(a) == 5 * 5 * 3
    assert all((x.goal_world_from_camera == y.goal_world_from_camera).all() for x, y in zip(a, b, strict=True))
    assert all((x.goal_world_from_camera != y.goal_world_from_camera).any() for x, y in zip(a, other, strict=True))
    assert {(s.target, len(s.objects)) for s in a} == {(t, n) for t in SIZES for n in range(1, 6)}


def test_generated_scenes_keep_the_papers_rules():
    """As in the paper's own, a goal may lie inside a sphere, but only where another object's moved it there."""
    for scene in generate_split(SIZES, seed=11, repeats=8):
        assert not overlapping(scene, SIZES)
        centers = np.array([p.center_m for p in scene.objects])
        sizes = np.array([SIZES[p.name] for p in scene.objects])
        assert np.abs(centers[:, :2]).max() <= 0.25
        np.testing.assert_allclose(centers[:, 2], sizes[:, 2] / 2)
        position = scene.goal_world_from_camera[:3, 3]
        assert (position >= LOWER_M).all()
        assert (position <= UPPER_M).all()
        if len(scene.objects) == 1:
            assert spheres_around(centers, sizes).depth_m(position) <= 1e-9


def test_goals_look_at_the_target_unless_clipped():
    """The position is clipped, the rotation is not."""
    looking = 0
    scenes = generate_split(SIZES, seed=12, repeats=8)
    for scene in scenes:
        goal = scene.goal_world_from_camera
        towards = rotation_towards(scene.target_placed.center_m - goal[:3, 3])
        looking += rotation_angle(goal[:3, :3], towards) < 1e-6
        assert abs(goal[2, 0]) < 1e-9, "a goal has no roll"
    assert looking > 0.5 * len(scenes)


def test_yaw_is_random_or_fixed():
    rng = np.random.default_rng(0)
    yaws = [p.yaw_rad for _ in range(40) for p in generate_scene(rng, SIZES, "can", 3).objects]
    assert min(yaws) < -2.5
    assert max(yaws) > 2.5
    assert all(p.yaw_rad == 0 for p in generate_scene(rng, SIZES, "can", 5, yaw="fixed").objects)


def test_more_objects_than_there_are_is_refused():
    with pytest.raises(SaccadeError, match=r"lower scene\.n_objects"):
        generate_scene(np.random.default_rng(0), SIZES, "can", 6)


def test_objects_that_cannot_fit_are_refused():
    with pytest.raises(SaccadeError, match="do not fit"):
        generate_scene(np.random.default_rng(0), {"a": (1, 1, 1), "b": (1, 1, 1)}, "a", 2)


def test_a_crowded_table_is_laid_anew_until_all_fit():
    sizes = {str(k): (0.15, 0.15, 0.1) for k in range(6)}
    for seed in range(10):
        scene = generate_scene(np.random.default_rng(seed), sizes, "0", 6)
        assert not overlapping(scene, sizes)
