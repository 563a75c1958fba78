"""The simulator's core: what an episode publishes, and bad input that is refused in one line."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from saccade.services.simulator.core import SERVICE, Simulator, build, scenes_of
from saccade.services.simulator.scenes import generate_scene, save_scenes
from saccade.shared.bus.messages import Action
from saccade.shared.bus.wire import decode, encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.render.objects import load_mesh, names_in_use
from saccade.shared.render.world import World
from saccade.shared.world.geometry import look_at
from saccade.shared.world.goal_image import read_goal_image
from saccade.shared.world.task import start_pose

NAMES = ("soup_can", "rice_box")


@pytest.fixture(scope="module")
def world():
    world = World(tuple(load_mesh("pantry", name) for name in NAMES))
    yield world
    world.close()


@pytest.fixture(scope="module")
def scenes(world):
    rng = np.random.default_rng(4)
    sizes = {name: mesh.size_m for name, mesh in world.meshes.items()}
    return [generate_scene(rng, sizes, target, 2, scene_id=target) for target in NAMES]


def by_topic(outputs):
    return {output.topic.name: output.message for output in outputs}


def act(step, translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0), **more):
    return {"action": Action(run="r", episode=0, step=step, translation_m=np.array(translation, dtype=np.float64),
                             rotation_rad=np.array(rotation, dtype=np.float64), **more)}


def home(simulator):
    """The action that puts the camera at the goal in one step, where it is within reach of one."""
    simulator.state.camera = simulator.state.goal.copy()
    return act(simulator.state.step)


def test_an_episode_begins_with_goal_frame_and_truth(world, scenes):
    simulator = Simulator(world, scenes)
    outputs = by_topic(simulator.begin("r", 1))
    assert simulator.episodes == 2
    assert set(outputs) == {topic.name for topic in SERVICE.outputs}
    assert {(m.run, m.episode, m.step) for m in outputs.values()} == {("r", 1, 0)}
    np.testing.assert_array_equal(outputs["frame"].world_from_camera, start_pose())
    np.testing.assert_array_equal(outputs["frame"].rgb, world.render(start_pose()))
    truth = outputs["truth"]
    assert (truth.scene, truth.target, truth.success, truth.done) == ("rice_box", "rice_box", False, False)
    assert truth.names == [p.name for p in scenes[1].objects]
    assert outputs["frame"].depth_m is None


def test_every_message_is_valid_on_the_wire(world, scenes):
    simulator = Simulator(world, scenes, publish_depth=True)
    for output in [*simulator.begin("r", 0), *simulator.step(act(0, (0.1, 0, 0)))]:
        back = decode(output.topic.type, encode(output.message))
        for field in dataclasses.fields(back):
            np.testing.assert_array_equal(getattr(back, field.name), getattr(output.message, field.name))


def test_steps_count_the_actions(world, scenes):
    simulator = Simulator(world, scenes)
    simulator.begin("r", 0)
    for step in range(3):
        outputs = by_topic(simulator.step(act(step, (-0.02, 0.01, 0.0), (0, 0, 0.05))))
        assert outputs["frame"].step == outputs["truth"].step == step + 1
        np.testing.assert_array_equal(outputs["frame"].world_from_camera, outputs["truth"].world_from_camera)
    expected = start_pose()[:3, 3] + 3 * np.array([-0.02, 0.01, 0.0])
    np.testing.assert_allclose(outputs["frame"].world_from_camera[:3, 3], expected)


def test_the_goal_shows_only_target_and_table(world, scenes):
    """The other object is not in the goal image, whatever its place; the view is that of the goal's pose."""
    for episode, scene in enumerate(scenes):
        goal = by_topic(Simulator(world, scenes).begin("r", episode))["goal"]
        placed = scene.target_placed
        world.place({placed.name: (placed.center_m, placed.yaw_rad)}, scene.table_rgb)
        np.testing.assert_array_equal(goal.rgb, world.render(scene.goal_world_from_camera))
        assert world.render_masks(scene.goal_world_from_camera)[scene.target].any()


def test_nothing_is_moved_by_drawing_the_goal(world, scenes):
    """After the goal image all objects are back on the table: the first frame shows them."""
    Simulator(world, scenes).begin("r", 0)
    assert set(world.poses) == set(NAMES)


def test_an_episode_is_deterministic(world, scenes):
    def play():
        simulator = Simulator(world, scenes, publish_depth=True)
        outputs = list(simulator.begin("r", 0))
        rng = np.random.default_rng(1)
        for step in range(4):
            outputs += simulator.step(act(step, rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1, 3)))
        return [encode(output.message) for output in outputs]

    assert play() == play()


def test_no_frame_comes_after_success(world, scenes):
    simulator = Simulator(world, scenes)
    simulator.begin("r", 0)
    outputs = by_topic(simulator.step(home(simulator)))
    assert set(outputs) == {"truth"}
    assert outputs["truth"].success
    assert outputs["truth"].done
    assert simulator.step(act(1)) == []


def test_the_last_step_gives_no_frame(world, scenes):
    simulator = Simulator(world, scenes, max_steps=2)
    simulator.begin("r", 0)
    assert "frame" in by_topic(simulator.step(act(0)))
    outputs = by_topic(simulator.step(act(1)))
    assert set(outputs) == {"truth"}
    assert outputs["truth"].done
    assert not outputs["truth"].success


def test_a_new_episode_forgets_the_old(world, scenes):
    simulator = Simulator(world, scenes)
    first = [encode(o.message) for o in simulator.begin("r", 0)]
    simulator.step(act(0, (0.3, 0.3, 0.3), arrived=True))
    assert [encode(o.message) for o in simulator.begin("r", 0)] == first


def test_an_episode_that_does_not_exist_is_refused(world, scenes):
    with pytest.raises(SaccadeError, match="episode 2 does not exist"):
        Simulator(world, scenes).begin("r", 2)


def test_exploring_has_no_goal_image_and_no_success(world, scenes):
    simulator = Simulator(world, scenes, explore=True)
    assert by_topic(simulator.begin("r", 0))["goal"].rgb is None
    assert not by_topic(simulator.step(home(simulator)))["truth"].success


def test_with_the_users_goal_the_agent_ends_the_episode(world, scenes):
    """Where that view is, nobody knows: only the agent's word ends the search."""
    picture = np.full((480, 480, 3), 9, dtype=np.uint8)
    simulator = Simulator(world, scenes, goal_rgb=picture)
    np.testing.assert_array_equal(by_topic(simulator.begin("r", 0))["goal"].rgb, picture)
    assert "frame" in by_topic(simulator.step(home(simulator)))
    truth = by_topic(simulator.step(act(1, arrived=True)))["truth"]
    assert (truth.done, truth.success, truth.declared, truth.declared_true) == (True, False, True, False)


def test_an_absent_target_is_in_the_goal_image_only(world, scenes):
    scene = dataclasses.replace(scenes[0], target_absent=True)
    outputs = by_topic(Simulator(world, [scene]).begin("r", 0))
    np.testing.assert_array_equal(outputs["goal"].rgb, by_topic(Simulator(world, scenes).begin("r", 0))["goal"].rgb)
    outputs = by_topic(Simulator(world, [scene]).begin("r", 0))
    assert outputs["truth"].names == ["rice_box"]
    assert set(world.poses) == {"rice_box"}
    np.testing.assert_array_equal(outputs["truth"].target_center_m, scene.target_placed.center_m)


def bad_goals(folder):
    Image.new("RGB", (480, 480)).save(folder / "other.bmp")
    Image.new("RGB", (480, 20)).save(folder / "flat.png")
    (folder / "text.png").write_text("not an image")
    rng = np.random.default_rng(0)
    for name in ("cut.png", "cut.jpg"):
        Image.fromarray(rng.integers(0, 255, (480, 480, 3), dtype=np.uint8)).save(folder / name)
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[:len(whole) // 2])


@pytest.mark.parametrize(("name", "words"), [
    ("flat.png", "is 480x20 pixels"), ("other.bmp", "neither PNG nor JPEG"), ("text.png", "neither PNG nor JPEG"),
    ("cut.png", "cannot be read"), ("cut.jpg", "cannot be read"), ("nowhere.png", "cannot be read"),
    ("", "cannot be read")])
def test_a_bad_goal_image_is_refused_in_one_line(tmp_path, name, words):
    bad_goals(tmp_path)
    config = Config().with_values({"scene.goal_image": str(tmp_path / name), "scene.names": ["soup_can"]})
    with pytest.raises(SaccadeError) as caught:
        build(config)
    assert words in str(caught.value)
    assert str(caught.value).startswith("goal image ")
    assert "\n" not in str(caught.value)


def test_a_goal_image_of_any_size_and_its_intrinsics_reach_the_goal(tmp_path):
    """And what is said about them is a note."""
    pixels = np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "goal.png")
    keys = {"scene.goal_image": str(tmp_path / "goal.png"), "scene.names": ["soup_can"]}
    for given, words in ((None, "60 degrees is assumed"), ([500, 500, 200, 150], "those that you gave")):
        simulator = build(Config().with_values(keys | {"scene.goal_intrinsics_px": given}))
        try:
            goal = by_topic(simulator.begin("r", 0))["goal"]
        finally:
            simulator.world.close()
        np.testing.assert_array_equal(goal.rgb, read_goal_image(tmp_path / "goal.png", given).rgb)
        note, = simulator.notes
        assert words in note


def damaged_scan(folder, fault):
    """A YCB folder with four points in it, and something wrong."""
    scan = folder / "003_cracker_box"
    scan.mkdir()
    obj = "v 0 0 0\nv 0 0 1\nv 0 1 0\nv 1 0 0\nvt 0 0\nvt 0 1\nvt 1 0\nf 1/1 2/2 4/3\nf 1/1 2/2 3/3\n"
    if fault == "face":
        obj = obj.replace("3/3", "9/3")
    if fault != "no mesh":
        (scan / "textured.obj").write_text("rubbish\n" if fault == "mesh" else obj)
    if fault == "texture":
        (scan / "texture_map.png").write_bytes(b"rubbish")
    elif fault != "no texture":
        Image.new("RGB", (8, 8)).save(scan / "texture_map.png")


@pytest.mark.parametrize(("fault", "words"), [
    ("no mesh", "textured.obj is missing"), ("mesh", "textured.obj is damaged"), ("face", "textured.obj is damaged"),
    ("no texture", "texture_map.png (or .jpg) is missing"), ("texture", "texture_map.png is damaged")])
def test_a_missing_or_damaged_scan_is_named(tmp_path, monkeypatch, fault, words):
    damaged_scan(tmp_path, fault)
    monkeypatch.setenv("SACCADE_YCB", str(tmp_path))
    config = Config().with_values({"scene.objects": "ycb", "scene.names": ["003_cracker_box"]})
    with pytest.raises(SaccadeError) as caught:
        build(config)
    assert words in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


SIZES = {name: (0.1, 0.1, 0.1) for name in NAMES}


def test_scenes_come_from_the_seed():
    config = Config().with_values({"scene.count": 4, "seed": 3})
    drawn, again = scenes_of(config, SIZES), scenes_of(config, SIZES)
    longer = scenes_of(config.with_values({"scene.count": 6}), SIZES)
    other = scenes_of(config.with_values({"seed": 4}), SIZES)
    poses = [[s.goal_world_from_camera.tolist() for s in scenes] for scenes in (drawn, again, longer, other)]
    assert len(poses[0]) == 4
    assert poses[0] == poses[1] == poses[2][:4]
    assert poses[0] != poses[3]


def test_number_and_yaw_are_configured():
    config = Config().with_values({"scene.count": 3, "scene.n_objects": 2, "scene.yaw": "fixed"})
    assert all(len(s.objects) == 2 and all(p.yaw_rad == 0 for p in s.objects) for s in scenes_of(config, SIZES))


def test_a_scene_is_chosen_by_its_id(tmp_path):
    save_scenes(tmp_path / "s.json", scenes_of(Config().with_values({"scene.count": 3}), SIZES))
    config = Config().with_values({"scene.file": str(tmp_path / "s.json")})
    scenes = scenes_of(config, SIZES)
    assert len(scenes) == 3
    chosen, = scenes_of(config.with_values({"scene.scene": scenes[1].id}), SIZES)
    assert chosen.id == scenes[1].id
    with pytest.raises(SaccadeError, match="'nothing' is not in"):
        scenes_of(config.with_values({"scene.scene": "nothing"}), SIZES)


@pytest.mark.parametrize(("values", "words"), [
    ({"scene.names": ["dog"]}, "'dog' is not in 'pantry'"), ({"scene.names": []}, "at least one"),
    ({"scene.names": ["soup_can", "soup_can"]}, "each once")])
def test_bad_names_are_refused(values, words):
    with pytest.raises(SaccadeError, match=words):
        names_in_use(Config().with_values(values).scene)


def test_a_scene_id_without_a_file_is_refused():
    with pytest.raises(SaccadeError, match=r"needs scene\.file"):
        scenes_of(Config().with_values({"scene.scene": "x"}), SIZES)


def test_a_file_of_the_other_set_is_refused(tmp_path):
    save_scenes(tmp_path / "s.json", scenes_of(Config(), {"can": (0.1, 0.1, 0.1)}))
    assert json.loads((tmp_path / "s.json").read_text())["scenes"]
    with pytest.raises(SaccadeError, match="'can' is not in use"):
        scenes_of(Config().with_values({"scene.file": str(tmp_path / "s.json")}), SIZES)


def test_a_built_simulator_runs():
    simulator = build(Config().with_values({"scene.names": list(NAMES), "simulator.publish_depth": True}))
    outputs = by_topic(simulator.begin("r", 0))
    assert outputs["frame"].depth_m.shape == (480, 480)
    assert outputs["frame"].rgb.any()
    camera = look_at([0, 0, 0.5], [0, 0, 0])
    assert simulator.world.render(camera).shape == (480, 480, 3)
    simulator.world.close()
