"""Agents whose perception estimates poses: PoseCNN, and render and compare; their planners follow the transform."""

import io
import re

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from rich.console import Console

from saccade.app.cli.options import AGENTS as AGENTS_IN_HELP
from saccade.app.cli.texts import configured
from saccade.app.run.registry import AGENTS, local_pairs
from saccade.app.run.run import run
from saccade.services.perception.posecnn import hough_center, network_input, rotation_of
from saccade.services.perception.templates import TemplateMatcher
from saccade.services.planner.follow import Follower, goal_view
from saccade.shared.bus.messages import Percept
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import (
    INTRINSICS_PX,
    direction,
    look_at,
    pixel_rays,
    pose,
    project,
    rotation_angle,
    rotation_onto,
    rotation_xyz,
)
from saccade.shared.world.task import apply_action, start_pose, success
from saccade.tests.fakes.logs import assert_replayed, logged
from saccade.tests.fakes.training import assert_same_checkpoint, interrupt_and_resume
from saccade.tests.fakes.weights import write_random_weights
from saccade.tests.samples import sample
from saccade.training.part import Trainer
from saccade.training.posecnn import rotation_loss
from saccade.training.rendered import RenderedScenes
from saccade.training.run import export, start
from saccade.training.settings import TrainingConfig

NAMES = ("soup_can", "rice_box")
EPISODE = {"scene.names": list(NAMES), "scene.n_objects": 2, "simulator.max_steps": 4, "seed": 4}
TINY = TrainingConfig(objects="pantry", names=NAMES, steps_extraction=4, batch_extraction=2, checkpoint_every=2,
                      device="cpu", architecture="posecnn")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    write_random_weights(folder, "pantry", NAMES, "posecnn")
    return folder


def test_the_help_names_the_agents_of_the_registry():
    named = re.sub(r" \(.*?\)", "", AGENTS_IN_HELP).replace("or ", "").split(", ")
    assert named == list(AGENTS)


@pytest.mark.parametrize("center", [(0.4, 0.55), (-0.1, 0.5)], ids=["in the image", "beyond its border"])
def test_the_centre_is_where_most_votes_meet(center):
    generator = torch.Generator().manual_seed(0)
    cells = torch.rand(60, 2, generator=generator) * 0.3 + 0.3
    directions = F.normalize(torch.tensor(center) - cells, dim=-1)
    directions[:15] = F.normalize(torch.randn(15, 2, generator=generator), dim=-1)
    found, inliers = hough_center(cells, directions, torch.ones(60))
    assert found.tolist() == pytest.approx(center, abs=0.01)
    assert inliers[15:].all()
    assert inliers[:15].sum() < 8


def test_a_network_is_told_whether_there_is_a_depth():
    image, depth = torch.rand(1, 3, 480, 480), torch.full((1, 480, 480), 1.0)
    assert network_input(image, None)[:, 3:].abs().max() == 0
    assert network_input(image, depth)[:, 3:].unique().tolist() == [1.0]
    assert network_input(image, depth * 0.25)[0, 3:, 0, 0].tolist() == [-0.5, 1.0]


def test_the_loss_of_a_symmetric_object_forgives_what_looks_alike():
    turned = torch.tensor([[np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]], dtype=torch.float32)  # by 90 degrees
    square = torch.tensor([[[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]])
    true = torch.eye(3)[None]
    assert torch.allclose(rotation_of(turned)[0] @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)
    assert float(rotation_loss(turned, true, square, torch.tensor([True]))) == pytest.approx(0.0, abs=1e-6)
    assert float(rotation_loss(turned, true, square, torch.tensor([False]))) == pytest.approx(4.0)
    assert float(rotation_loss(torch.tensor([[1.0, 0, 0, 0]]), true, square, torch.tensor([False]))) == 0.0


def test_the_labels_of_a_rendered_image_are_the_poses_of_its_objects():
    scenes = RenderedScenes([load_mesh("pantry", name) for name in NAMES])
    batch = scenes.compose(6, np.random.default_rng(1))
    rng, checked = np.random.default_rng(1), 0
    for n in range(6):
        camera, placed = scenes.scenes.draw(rng)
        rng.random(3), rng.uniform(size=3), rng.standard_normal((160, 160, 3), dtype=np.float32)  # of the image
        for which, at, yaw in placed:
            pixel = batch.center[n, which].double().numpy() * 480
            ray = pixel_rays(pixel, INTRINSICS_PX)
            rotation = rotation_onto(ray) @ batch.rotation[n, which].double().numpy()
            told = camera @ pose(rotation, 0.4 / np.exp(float(batch.log_scale[n, which])) * ray)
            if project(at, camera, INTRINSICS_PX)[1] > 0.05:
                assert told == pytest.approx(pose(rotation_xyz((0, 0, yaw)), at), abs=1e-3)
                checked += 1
            if batch.seen[n, which] and pixel.min() > 0 and pixel.max() < 480:
                v, u = torch.nonzero(batch.label[n] == which + 1).double().mean(0) / 80
                assert abs(float(u) - pixel[0] / 480) + abs(float(v) - pixel[1] / 480) < 0.3
    assert checked > 3


def test_training_continues_as_if_it_had_not_been_interrupted_and_its_weights_serve(tmp_path, monkeypatch):
    monkeypatch.setattr("saccade.training.posecnn.EVALUATED", 10)
    for name, interrupted in (("whole", 4), ("resumed", 3)):
        start(tmp_path / name, TINY)
        if interrupted == 4:
            Trainer(tmp_path / name, "posecnn").train()
        else:
            interrupt_and_resume(tmp_path / name, "posecnn", before_step=interrupted)
    assert_same_checkpoint(tmp_path / "whole", tmp_path / "resumed", "posecnn")
    export(tmp_path / "whole", tmp_path / "weights")
    trained = Weights(tmp_path / "weights")
    assert (trained.architecture, trained.names) == ("posecnn", NAMES)
    assert set(trained.calibration) == {f"{name}.{what}" for name in NAMES for what in ("pixel_std", "log_scale_std")}


def test_training_goes_on_from_the_network_of_other_weights_of_the_same_objects(weights, tmp_path):
    start(tmp_path / "more", TINY.model_copy(update={"begin_with": str(weights)}))
    trainer, before = Trainer(tmp_path / "more", "posecnn"), Weights(weights).state("posecnn")
    assert all(np.array_equal(value.numpy(), before[key]) for key, value in trainer.task.module.state_dict().items())
    start(tmp_path / "others", TINY.model_copy(update={"begin_with": str(weights), "names": NAMES[::-1]}))
    with pytest.raises(SaccadeError, match=r"are of soup_can, rice_box, not of rice_box, soup_can in this order"):
        Trainer(tmp_path / "others", "posecnn")


@pytest.mark.parametrize("agent", ["posecnn", "posecnn-infogain"])
def test_an_agent_runs_on_the_bus_and_in_one_process_alike_and_is_replayed(agent, tmp_path, weights):
    logs = {}
    for kind in ("zenoh", "local"):
        config, _ = configured(None, EPISODE | {"bus.kind": kind, "perception.weights": weights}, [], agent)
        out = tmp_path / kind / "same"
        run(config, agent=agent, out=out, plain=True, console=Console(file=io.StringIO()))
        logs[kind] = logged(out / "run.mcap")
        assert ("belief", "soup_can") in logs[kind] or agent == "posecnn"
    assert logs["zenoh"] == logs["local"]
    into = ("perception", "planner") if agent == "posecnn" else ("perception", "belief", "planner")
    assert_replayed(out / "run.mcap", tmp_path / "replay", *into)
    percepts = [m for topic, _, m in RunReader(out / "run.mcap") if isinstance(m, Percept)]
    assert percepts
    for percept in percepts:
        assert percept.latent_mean.size == 0
        assert np.linalg.det(percept.camera_from_object[:3, :3]) == pytest.approx(1.0)


def test_an_agents_preset_gives_way_to_what_the_user_says(tmp_path, weights):
    path = tmp_path / "mine.toml"
    path.write_text("[simulator]\npublish_depth = false\n[planner]\nstep_m = 0.03\n")
    config, _ = configured(path, {"perception.weights": weights}, ["seed=3"], "posecnn")
    assert (config.simulator.publish_depth, config.planner.step_m, config.seed) == (False, 0.03, 3)
    assert config.services.planner == "saccade.services.planner.follow"


@pytest.mark.parametrize(("agent", "of"), [("posecnn", "default"), ("sceneccn", "posecnn")])
def test_weights_of_another_architecture_get_one_line(agent, of, tmp_path):
    write_random_weights(tmp_path / "w", "pantry", NAMES, of)
    config, _ = configured(None, EPISODE | {"perception.weights": tmp_path / "w"}, [], agent)
    with pytest.raises(SaccadeError, match=f"{tmp_path / 'w'}.*{of}.*{'posecnn' if of == 'default' else 'default'}"):
        local_pairs(agent, config)


def perfect(camera, center, yaw, **changes):
    """What a perception without errors says of an object at `center`, turned by `yaw`."""
    seen = np.linalg.inv(camera) @ pose(rotation_xyz((0.0, 0.0, yaw)), center)
    fields = {"object": "mug", "presence": 0.99, "world_from_camera": camera, "camera_from_object": seen}
    return sample(Percept, **fields | changes)


def test_whoever_sees_poses_rightly_reaches_the_goal_and_does_not_lose_the_target():
    center, goal = np.array([0.1, -0.1, 0.05]), look_at(np.array([-0.3, 0.2, 0.4]), np.array([0.1, -0.1, 0.05]))
    # The goal image was taken of the same object at another place, in another direction: only the relative pose counts.
    elsewhere = pose(rotation_xyz((0.0, 0.0, 1.1)), (0.7, 0.3, 0.05)) @ np.linalg.inv(pose(np.eye(3), center))
    wanted = perfect(elsewhere @ goal, (elsewhere @ [*center, 1.0])[:3], 1.1)
    camera, follower = start_pose(), Follower(Config())
    assert goal_view(perfect(camera, center, 0.0), wanted) == pytest.approx(goal)
    follower.begin("r", 0)
    for _step in range(40):
        plan, action = (o.message for o in follower.step({"percept": {"mug": perfect(camera, center, 0.0)},
                                                          "goal_percept": {"mug": wanted}}))
        assert np.linalg.norm(action.translation_m) <= 0.05 + 1e-9
        if action.arrived:
            break
        camera = apply_action(camera, action.translation_m, action.rotation_rad)
        pixel, _ = project(center, camera, INTRINSICS_PX)
        assert np.abs(pixel - 240).max() < 300  # a part of it at least
    assert plan.arrived
    assert success(camera, goal)


def test_where_the_target_is_not_seen_the_camera_stops():
    center, follower = np.array([0.1, -0.1, 0.05]), Follower(Config())
    follower.begin("r", 0)
    unseen = perfect(start_pose(), center, 0.0, presence=0.1)
    _, action = (o.message for o in follower.step({"percept": {"mug": unseen},
                                                   "goal_percept": {"mug": perfect(start_pose(), center, 0.0)}}))
    assert not np.any([action.translation_m, action.rotation_rad])
    with pytest.raises(SaccadeError, match="the percepts carry none"):
        list(follower.step({"percept": {"mug": perfect(start_pose(), center, 0.0, camera_from_object=None)},
                            "goal_percept": {"mug": unseen}}))


def test_templates_find_how_an_object_is_turned():
    """From a dozen directions, with the shipped detector: three quarters within half the task's tolerance."""
    names = ("cereal_box", "rice_box")
    config, _ = configured(None, {"scene.names": list(names)}, [], "render-and-compare")
    matcher = TemplateMatcher(Weights(config.weights), "pantry", names, 2)
    world, right = World(tuple(load_mesh("pantry", name) for name in names)), 0
    for n in range(12):
        center, yaw = np.array([0.05, 0.0, world.meshes[names[n % 2]].size_m[2] / 2]), 0.5 * n
        camera = look_at(center + 0.45 * direction(2.1 * n, 0.5 + 0.05 * n), center)
        world.place({names[n % 2]: (center, yaw)})
        seen = matcher.see(world.render(camera), INTRINSICS_PX, camera[2, :3])
        told = camera @ seen.camera_from_object[n % 2]
        right += rotation_angle(told[:3, :3], rotation_xyz((0, 0, yaw))) < 0.25
    assert right >= 9


def test_of_two_of_a_kind_each_has_its_pose():
    names = ("cereal_box", "soup_can")
    config, _ = configured(None, {"scene.names": list(names)}, [], "render-and-compare")
    world = World(tuple(load_mesh("pantry", name) for name in names), further={"soup_can#2": "soup_can"})
    height = world.meshes["soup_can"].size_m[2] / 2
    centers = {"soup_can": np.array([0.0, 0.15, height]), "soup_can#2": np.array([0.0, -0.15, height])}
    world.place({label: (center, 0.0) for label, center in centers.items()})
    seen = TemplateMatcher(Weights(config.weights), "pantry", names, 2).see(
        world.render(start_pose()), INTRINSICS_PX, start_pose()[2, :3])
    told = [(start_pose() @ each)[:3, 3] for each in seen.camera_from_object]
    assert seen.kinds == (1,)
    assert sorted(told[row][1] for row in seen.rows_of(1)) == pytest.approx([-0.15, 0.15], abs=0.06)


def test_who_renders_and_compares_runs_within_one_process_and_is_replayed(tmp_path):
    config, _ = configured(None, EPISODE | {"simulator.max_steps": 2, "bus.kind": "local"}, [], "render-and-compare")
    run(config, agent="render-and-compare", out=tmp_path / "r", plain=True, console=Console(file=io.StringIO()))
    assert_replayed(tmp_path / "r" / "run.mcap", tmp_path / "replay", "perception", "belief", "planner")
    poses = [m.camera_from_object for _, _, m in RunReader(tmp_path / "r" / "run.mcap") if isinstance(m, Percept)]
    assert len(poses) == 2 * (2 + 1)
