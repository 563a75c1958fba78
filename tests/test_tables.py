"""Tables as tables are: what each suite promises, the same scenes from a seed, and that the oracle solves them."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from rich.console import Console

from saccade.app.bench.bench import bench, prepare
from saccade.services.planner.oracle import Oracle
from saccade.services.simulator.core import Simulator
from saccade.services.simulator.gym_env import ID
from saccade.services.simulator.physics import at_rest, height_on
from saccade.services.simulator.scene import Obstacle, Placed, Table, placed_at
from saccade.services.simulator.scene_entry import entry_of, scene_from
from saccade.services.simulator.stage import boxes_around
from saccade.services.simulator.tables import TABLES, draw_tables
from saccade.shared.bus.messages import Action, Goal, Truth
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.render.look import FLAT
from saccade.shared.render.objects import PANTRY_NAMES, load_mesh
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, rotation_angle, rotation_xyz
from saccade.shared.world.task import start_pose

COUNT = 5  # of each kind: one for each target
MESHES = {name: load_mesh("pantry", name) for name in PANTRY_NAMES}
SIZES = {name: mesh.size_m for name, mesh in MESHES.items()}


@pytest.fixture(scope="module")
def drawn():
    return {kind: draw_tables(kind, MESHES, 7, COUNT) for kind in TABLES}


class Unseen:
    """A world that renders nothing: the oracle needs no images."""

    meshes, look, intrinsics_px = MESHES, FLAT, np.array(INTRINSICS_PX)

    def place(self, *_):
        pass

    def furnish(self, *_):
        pass

    def render(self, _camera):
        return np.zeros((4, 4, 3), np.uint8)


def solved(scene):
    """All truths of the oracle's episode."""
    simulator, oracle = Simulator(Unseen(), [scene], max_steps=120), Oracle()
    outputs, truths = list(simulator.begin("r", 0)), []
    goal: Goal = outputs[0].message
    oracle.begin("r", 0)
    while True:
        truth: Truth = outputs[-1].message
        truths.append(truth)
        if truth.done:
            return truths
        action: Action = oracle.step({"truth": truth, "goal": goal})[0].message
        outputs = simulator.step({"action": action})


@pytest.mark.parametrize("kind", TABLES)
def test_the_oracle_solves_it_and_runs_through_nothing(drawn, kind):
    for scene in drawn[kind]:
        truths = solved(scene)
        assert truths[-1].success, scene.id
        for truth in truths:
            boxes = boxes_around([placed_at(n, 1, c, r) for n, c, r in zip(
                truth.names, truth.centers_m, truth.world_from_objects(), strict=True)], SIZES)
            assert boxes.distances_m(truth.world_from_camera[:3, 3]).min() > 0.0599


def test_where_no_way_leads_to_the_goal_the_oracle_stays_where_it_is(drawn):
    """A wall from end to end of the workspace: it does not run into it, and does not say that it arrived."""
    scene = drawn["twins"][0]
    wall = Obstacle(np.array([0.32, 0.0, 0.4]), np.array([0.02, 4.0, 2.0]))
    goal = look_at([-0.2, 0.0, 0.45], [0.0, 0.0, 0.0])
    truths = solved(replace(scene, obstacles=(wall,), goal_world_from_camera=goal,
                            objects=(scene.target_placed,)))
    assert not truths[-1].success
    assert not truths[-1].declared
    assert np.ptp([t.world_from_camera[:3, 3] for t in truths[1:]], axis=0).max() < 1e-9


@pytest.mark.parametrize("kind", TABLES)
def test_a_scene_goes_into_a_file_and_comes_back(drawn, kind):
    for scene in drawn[kind]:
        told = json.loads(json.dumps(entry_of(scene)))
        assert entry_of(scene_from(told, PANTRY_NAMES)) == told


def test_the_seed_decides_and_every_target_has_its_turn(drawn):
    for kind in ("twins", "lying", "drifting"):
        again, other = draw_tables(kind, MESHES, 7, COUNT), draw_tables(kind, MESHES, 8, 1)
        assert [entry_of(s) for s in again] == [entry_of(s) for s in drawn[kind]]
        assert entry_of(other[0])["objects"] != entry_of(again[0])["objects"]
        assert Counter(s.target for s in drawn[kind]) == dict.fromkeys(PANTRY_NAMES, 1)


def test_twins(drawn):
    for scene in drawn["twins"]:
        kinds = Counter(p.name for p in scene.objects)
        assert 5 <= len(scene.objects) <= 7
        assert 2 <= kinds[scene.target] <= 4
        assert all(p.upright for p in scene.objects)


def test_what_lies_is_at_rest(drawn):
    """An object of a scene that is let go where it is stays there; cameras and goals are rolled."""
    for scene in drawn["lying"]:
        for before in scene.objects:
            others = [placed for placed in scene.objects if placed is not before]
            after, = at_rest(MESHES, [before], standing=others)
            assert np.linalg.norm(before.center_m - after.center_m) < 0.006
            assert rotation_angle(before.rotation, after.rotation) < 0.02
        right = scene.start_world_from_camera[:3, 0]
        assert abs(right[2]) > 1e-3
        assert abs(scene.goal_world_from_camera[2, 0]) > 1e-3
        np.testing.assert_allclose(scene.start_world_from_camera[:3, 2], start_pose()[:3, 2], atol=1e-12)


def test_something_happens_to_the_target_once(drawn):
    told = {scene.events[0].kind: scene for scene in draw_tables("moving", MESHES, 3, 11)[::5]}
    assert set(told) == {"moved", "taken", "pushed_over"}
    for scene in [*told.values(), *drawn["moving"]]:
        truths = solved(scene)
        happened = [t.events for t in truths if t.events]
        kind = scene.events[0].kind
        assert happened[0] == [f"{kind} {scene.target}"]
        assert len(happened) <= (2 if kind == "taken" else 1)
        if kind == "taken":
            assert sum(scene.target not in t.names for t in truths) == 10
        elif kind == "moved":
            assert 0.1 <= np.linalg.norm(scene.events[0].to.center_m - scene.target_placed.center_m) <= 0.3
        else:
            assert scene.events[0].to.rotation[2, 2] < 0.5


def test_the_target_drifts(drawn):
    for scene in drawn["drifting"]:
        truths = solved(scene)
        moved = [np.linalg.norm(b.target_center_m - a.target_center_m)
                 for a, b in pairwise(truths)]
        assert 0.004 < max(moved) <= 0.02 + 1e-9


def test_a_crowd_is_a_heap(drawn):
    for scene in drawn["crowd"]:
        assert 10 <= len(scene.objects) <= 15
        assert np.abs([p.center_m[:2] for p in scene.objects]).max() < 0.4
    assert any(p.center_m[2] > MESHES[p.name].size_m[2] for scene in drawn["crowd"] for p in scene.objects)


def test_anywhere(drawn):
    scenes = drawn["anywhere"]
    assert len({scene.table.height_m for scene in scenes}) == COUNT
    assert all(scene.obstacles for scene in scenes)
    assert len({type(scene.workspace) for scene in draw_tables("anywhere", MESHES, 1, 5)}) == 2
    starts = np.array([scene.start_world_from_camera[:3, 3] for scene in scenes])
    assert np.ptp(starts, axis=0).min() > 0.1


def test_what_falls_comes_to_rest():
    """A box that stands stays, one on its edge falls onto a side, one beside the table is lost."""
    size = MESHES["rice_box"].size_m
    standing = Placed("rice_box", np.array([0.1, 0.0, size[2] / 2]), 0.4)
    rest, = at_rest(MESHES, [standing])
    np.testing.assert_allclose(rest.center_m, standing.center_m, atol=2e-3)
    tipped = rotation_xyz([0.0, 1.0, 0.0])
    fallen, = at_rest(MESHES, [placed_at("rice_box", 1, np.array([0, 0, height_on(MESHES["rice_box"], tipped)]),
                                         tipped)])
    assert fallen.center_m[2] == pytest.approx(size[0] / 2, abs=3e-3)
    assert at_rest(MESHES, [placed_at("rice_box", 1, np.array([0.9, 0.0, 0.2]), tipped)]) is None
    high, = at_rest(MESHES, [placed_at("rice_box", 1, np.array([0, 0, 0.4]), tipped)], table=Table((1, 1), 0.2))
    assert high.center_m[2] == pytest.approx(0.2 + size[0] / 2, abs=3e-3)


def test_what_does_not_fit_is_said():
    big = {name: type(mesh)(name, mesh.vertices_m * 8, mesh.texcoords, mesh.faces, mesh.texture)
           for name, mesh in MESHES.items()}
    with pytest.raises(SaccadeError, match="does not fit on the table"):
        draw_tables("twins", big, 0, 1)


def test_the_bench_runs_a_suite(tmp_path):
    config = Config().with_values({"scene.names": ["soup_can", "rice_box"], "simulator.max_steps": 60})
    plan = prepare("oracle", config, tmp_path / "o.json", suite="twins", limit=2)
    assert len(plan.scenes) == 200
    records = bench(plan, jobs=1, command="bench", console=Console(quiet=True))
    assert [record["success"] for record in records] == [True, True]


@pytest.mark.parametrize("suite", ["twins", "anywhere", "yaw-500"])
def test_the_environment_draws_scenes_of_a_suite(suite):
    env = gymnasium.make(ID, names=("soup_can", "rice_box"), suite=suite, size_px=48)
    try:
        first, _ = env.reset(seed=4)
        again, _ = env.reset(seed=4)
        np.testing.assert_array_equal(first["image"], again["image"])
        assert first["image"].std() > 0
        env.step(np.zeros(6))
    finally:
        env.close()


def test_a_camera_may_be_farther_away_than_in_the_paper():
    """A shell that an arm reaches ends more than a metre from the middle of the table."""
    env = gymnasium.make(ID, names=("soup_can", "rice_box"), suite="anywhere", size_px=48)
    farthest = 0.0
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        farthest = max(farthest, float(np.abs(observation["pose"][:3, 3]).max()))
    assert farthest > 1.0
    env.close()


def test_the_environment_says_what_suites_there_are():
    with pytest.raises(SaccadeError, match="suite 'none' is unknown: choose from paper-500"):
        gymnasium.make(ID, suite="none")
    with pytest.raises(SaccadeError, match="suite 'paper-500' is of the objects 'ycb'"):
        gymnasium.make(ID, suite="paper-500")
