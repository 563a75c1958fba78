"""Scenes in which things happen, and of several of a kind: what the simulator shows, judges and repeats."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from saccade.services.evaluator.core import result_of
from saccade.services.simulator.core import Simulator, world_for
from saccade.services.simulator.scene import Drift, Event, Obstacle, Placed, Scene, Table, placed_at
from saccade.services.simulator.scenes import generate_scene
from saccade.services.simulator.stage import Stage
from saccade.shared.bus.messages import Action
from saccade.shared.bus.wire import encode
from saccade.shared.render.objects import load_mesh
from saccade.shared.world.geometry import look_at, rotation_xyz
from saccade.shared.world.task import start_pose, success
from saccade.shared.world.workspace import BoxReach

REACH = BoxReach(np.array([-0.6, -0.6, 0.05]), np.array([0.6, 0.6, 0.7]))
SIZES = {"soup_can": np.array([0.068, 0.068, 0.102]), "rice_box": np.array([0.05, 0.094, 0.176])}
FIRST, SECOND = Placed("soup_can", np.array([0.1, 0.1, 0.051]), 0.3), Placed(
    "soup_can", np.array([-0.1, -0.2, 0.051]), 1.3, 2)
BOX = Placed("rice_box", np.array([0.2, -0.1, 0.088]), 0.0)
GOAL = look_at([0.3, 0.3, 0.25], FIRST.center_m)


def scene(*events, objects=(FIRST, SECOND, BOX), **more):
    return Scene("s", "soup_can", (90, 120, 60), tuple(objects), GOAL, workspace=REACH, events=tuple(events), **more)


@pytest.fixture(scope="module")
def world():
    meshes = tuple(load_mesh("pantry", name) for name in SIZES)
    world = world_for(meshes, [scene(obstacles=(Obstacle(np.zeros(3), np.ones(3)),))])
    yield world
    world.close()


def play(world, scene, moves, **options):
    """All messages of an episode with these moves, by topic."""
    simulator = Simulator(world, [scene], **options)
    outputs = list(simulator.begin("r", 0))
    for step, move in enumerate(moves):
        outputs += simulator.step({"action": Action(run="r", episode=0, step=step, rotation_rad=np.zeros(3),
                                                    translation_m=np.asarray(move, dtype=np.float64))})
    return simulator, outputs


def truths(outputs):
    return [o.message for o in outputs if o.topic.name == "truth"]


def frames(outputs):
    return [o.message.rgb for o in outputs if o.topic.name == "frame"]


STILL = [(0, 0, 0)] * 6
EVENTS = (Event("moved", "soup_can", at_step=2, to=replace(FIRST, center_m=np.array([-0.1, 0.2, 0.051]))),
          Event("taken", "soup_can", 2, after_in_view=3), Event("put_back", "soup_can", 2, after_previous=2))


def test_both_of_a_kind_are_seen_and_told(world):
    _, outputs = play(world, scene(), [])
    truth, = truths(outputs)
    assert truth.labels() == ["soup_can", "soup_can#2", "rice_box"]
    assert world.render_masks(truth.world_from_camera)["soup_can#2"].any()
    assert (truth.in_view > 0.5).all()
    np.testing.assert_allclose(truth.world_from_objects()[1], SECOND.rotation)


def test_a_plain_scene_is_told_as_ever(world):
    """Nothing of its messages is new but absent fields, and its camera follows the rule of the paper."""
    rng = np.random.default_rng(1)
    simulator, outputs = play(world, generate_scene(rng, SIZES, "rice_box", 2), STILL)
    for truth in truths(outputs):
        assert [truth.instances, truth.rotations, truth.sizes_m, truth.in_view, truth.events] == [None] * 5
    assert outputs[0].message.workspace_m is None
    assert simulator.state.space is None


def test_events_happen_when_they_should(world):
    told = truths(play(world, scene(*EVENTS), STILL)[1])
    happened = {t.step: t.events for t in told if t.events}
    assert happened == {2: ["moved soup_can"], 3: ["taken soup_can#2"], 5: ["put_back soup_can#2"]}
    assert [("soup_can#2" in t.labels()) for t in told] == [True, True, True, False, False, True, True]
    np.testing.assert_array_equal(told[1].centers_m[0], FIRST.center_m)
    np.testing.assert_array_equal(told[2].centers_m[0], [-0.1, 0.2, 0.051])


def test_what_happens_is_in_the_images(world):
    images = frames(play(world, scene(*EVENTS), STILL)[1])
    changed = [bool((a != b).any()) for a, b in pairwise(images)]
    assert changed == [False, True, True, False, True, False]


def test_an_episode_that_is_played_again_is_equal_to_the_byte(world):
    """As after a killed simulator, which folds the episode anew. Another run of episodes before it changes nothing."""
    moves = [(0.02, -0.03, 0.01)] * 8
    drift = Event("drifts", "rice_box", at_step=1, drift=Drift(about_xy_m=(0.0, 0.0), turn_rad=0.05))
    shown = scene(*EVENTS, drift, obstacles=(Obstacle(np.array([0.0, -0.4, 0.1]), np.array([0.2, 0.05, 0.2])),),
                  table=Table((0.9, 1.1), 0.0))
    first = [encode(o.message) for o in play(world, shown, moves)[1]]
    play(world, generate_scene(np.random.default_rng(2), SIZES, "soup_can", 2), moves)
    assert [encode(o.message) for o in play(world, shown, moves)[1]] == first


def test_any_of_a_kind_is_a_success_and_the_nearest_is_judged(world):
    """The view of the second can that looks like the goal's view of the first."""
    simulator, _ = play(world, scene(), [])
    second = SECOND.world_from_object @ np.linalg.inv(FIRST.world_from_object) @ GOAL
    for goal, placed in ((GOAL, FIRST), (second, SECOND)):
        simulator.begin("r", 0)
        simulator.state.camera = goal.copy()
        truth = simulator.step({"action": Action(run="r", episode=0, step=0, translation_m=np.zeros(3),
                                                 rotation_rad=np.zeros(3))})[-1].message
        assert truth.success
        assert truth.target_instance == placed.instance
        np.testing.assert_allclose(truth.target_center_m, placed.center_m)
        np.testing.assert_allclose(truth.goal_world_from_camera, goal, atol=1e-9)
        assert result_of(truth).range_error_m < 1e-6


def test_a_lying_one_is_a_success_where_the_camera_can_see_it_so(world):
    """The goal view moves with the whole pose, also with its roll. What is below the table is no goal."""
    lying = placed_at("soup_can", 2, np.array([-0.1, -0.2, 0.034]), rotation_xyz([np.pi / 2, 0, 0.4]))
    views = Stage(scene(objects=(FIRST, lying)), SIZES).views(1, play(world, scene(), [])[0].state.spheres)
    assert set(views.instances) <= {1, 2}
    for pose, instance in zip(views.world_from_camera, views.instances, strict=True):
        placed = FIRST if instance == 1 else lying
        np.testing.assert_allclose(np.linalg.inv(placed.world_from_object) @ pose,
                                   np.linalg.inv(FIRST.world_from_object) @ GOAL, atol=1e-9)
        assert pose[2, 3] > 0


def test_the_goal_moves_with_its_object_and_is_gone_with_it(world):
    to = Placed("soup_can", np.array([-0.15, 0.05, 0.051]), 2.0)
    happens = (Event("moved", "soup_can", at_step=1, to=to), Event("taken", "soup_can", at_step=3))
    simulator, outputs = play(world, scene(*happens, objects=(FIRST, BOX)), STILL[:2])
    moved = to.world_from_object @ np.linalg.inv(FIRST.world_from_object) @ GOAL
    np.testing.assert_allclose(truths(outputs)[-1].goal_world_from_camera, moved, atol=1e-12)
    simulator.state.camera = moved.copy()
    last = simulator.step({"action": Action(run="r", episode=0, step=2, translation_m=np.zeros(3),
                                            rotation_rad=np.zeros(3))})[-1].message
    assert success(last.world_from_camera, moved)
    assert not last.success
    assert last.names == ["rice_box"]


def test_a_drifting_object_takes_the_goal_with_it(world):
    drift = Event("drifts", "soup_can", at_step=1, drift=Drift((-0.01, 0.0), steps=4))
    told = truths(play(world, scene(drift, objects=(FIRST, BOX)), STILL)[1])
    xs = [t.goal_world_from_camera[0, 3] - GOAL[0, 3] for t in told]
    np.testing.assert_allclose(xs, [0, -0.01, -0.02, -0.03, -0.04, -0.04, -0.04], atol=1e-9)
    assert [t.events for t in told] == [[], ["drifts soup_can"], [], [], [], [], []]


def test_the_camera_begins_where_the_scene_says_and_runs_through_nothing(world):
    """Into an obstacle, an object and the table: it stays away from all of them."""
    wall = Obstacle(np.array([0.3, 0.0, 0.3]), np.array([0.02, 1.0, 0.6]))
    start = look_at([0.5, 0.0, 0.4], [0, 0, 0])
    simulator, outputs = play(world, scene(obstacles=(wall,), start_world_from_camera=start),
                              [(-0.4, 0, 0), (0, 0, -0.5), (-0.5, 0, 0)])
    eyes = [t.world_from_camera[:3, 3] for t in truths(outputs)]
    np.testing.assert_array_equal(eyes[0], start[:3, 3])
    assert all(eye[0] > 0.3 + 0.01 + 0.0599 for eye in eyes)
    assert eyes[-1][2] >= 0.0599
    assert all(simulator.state.space.allows(eye) for eye in eyes)


def test_an_obstacle_hides_what_is_behind_it(world):
    wall = Obstacle(np.array([0.4, 0.0, 0.3]), np.array([0.02, 0.8, 0.6]), 0.0, (200, 30, 30))
    truth, = truths(play(world, scene(obstacles=(wall,)), [])[1])
    assert truth.in_view.max() == 0.0
    assert not any(mask.any() for mask in world.render_masks(start_pose()).values())


def test_another_table_is_higher_and_smaller(world):
    images = [frames(play(world, scene(objects=(FIRST,), table=table), [])[1])[0]
              for table in (None, Table((1.0, 1.0)), Table((0.5, 0.5)), Table((1.0, 1.0), 0.03))]
    assert (images[0] == images[1]).all()
    assert (images[0] != images[2]).any()
    assert (images[0] != images[3]).any()


def test_a_limit_from_outside_holds(world):
    simulator, _ = play(world, scene(), [(0.1, 0.0, 0.0), (0.1, 0.0, 0.0)], also=lambda points: points[:, 0] < 0.5)
    assert simulator.state.camera[0, 3] <= 0.5
