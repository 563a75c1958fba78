"""LEXA: it lives in one room, learns a world model, and its achiever is a planner; and two agents that know nothing."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from saccade.app.cli.texts import configured
from saccade.app.run.run import run
from saccade.services.planner.lexa import SCALE, Actor, StateSpaceModel, likeliest
from saccade.services.simulator.scenes import room_scenes
from saccade.shared.bus.messages import Action, Frame
from saccade.shared.bus.topics import STATUS
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.model.weights import MANIFEST, Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.world.task import apply_action, start_pose
from saccade.tests.fakes.logs import assert_replayed
from saccade.tests.fakes.training import assert_same_checkpoint, interrupt_and_resume
from saccade.tests.fakes.weights import write_random_weights
from saccade.training.lexa import room, task
from saccade.training.lexa.behaviour import achiever_loss, explorer_loss, returns
from saccade.training.lexa.replay import Episode, Replay
from saccade.training.lexa.world_model import Learner, distance_loss, distance_of, divergence, observe, patched
from saccade.training.part import Trainer
from saccade.training.run import export, start
from saccade.training.settings import TrainingConfig

NAMES = ("soup_can", "rice_box")
EPISODE = {"scene.names": list(NAMES), "scene.n_objects": 2, "simulator.max_steps": 4, "seed": 4}
TINY = TrainingConfig(objects="pantry", names=NAMES, steps_extraction=4, batch_extraction=2, checkpoint_every=2,
                      device="cpu", architecture="lexa", live_every=1)
SHORT_LIFE = {"EPISODE": 30, "FIRST": 2, "BLIND": 2, "BEHAVE_FROM": 1, "MEASURED": 2, "MEASURED_STEPS": 3}
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two tiny runs, one of them interrupted after its first checkpoint. Their lives are short: an episode by chance,
    the explorer's, and the achiever's."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("whole", "resumed"):
        start(folder / name, TINY)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SHORT_LIFE.items():
            patch.setattr(task, name, value)
        patch.setattr(room, "GOING", 20)
        Trainer(folder / "whole", "lexa").train()
        interrupt_and_resume(folder / "resumed", "lexa", before_step=3)
    export(folder / "whole", folder / "weights")
    return folder


def test_training_continues_as_if_it_had_not_been_interrupted(finished):
    assert_same_checkpoint(finished / "whole", finished / "resumed", "lexa")
    weights = Weights(finished / "weights")
    assert (weights.architecture, weights.names) == ("lexa", NAMES)
    weights.fill(Actor(), "lexa")  # what only training needs is not in them
    manifest = json.loads((finished / "weights" / MANIFEST).read_text())
    measured = manifest["losses"]["lexa"]
    assert measured["environment_steps"] == 30 * 6  # two episodes before the first step of learning, then one a step
    assert measured["nearest"] > 0.0
    assert measured["reached"] in (0.0, 0.5, 1.0)
    assert [row["environment_steps"] for row in manifest["measured"]] == [30 * 4, 30 * 6]  # at each checkpoint
    assert manifest["measured"][-1] == {key: measured[key] for key in manifest["measured"][-1]}


def test_the_goals_of_the_suite_are_neither_lived_in_nor_measured_on(tmp_path):
    """The room is the suite's. No goal ends an episode, not even the suite's first, which is 20 steps away here."""
    sizes = {name: load_mesh("pantry", name).size_m for name in NAMES}
    suite = room_scenes(sizes)
    home = room.Room("pantry", NAMES, tmp_path, 25)
    assert [p.center_m.tolist() for p in home.scene.objects] == [p.center_m.tolist() for p in suite[0].objects]
    assert home.scene.table_rgb == suite[0].table_rgb
    home.scene = replace(home.scene, goal_world_from_camera=start_pose())  # stood on in every step
    episode = home.live(lambda _image: np.zeros(6))
    assert (episode.images.shape, episode.actions.shape) == ((26, 32, 32, 3), (25, 6))
    assert np.array_equal(episode.images[0], episode.images[-1])
    known = [scene.goal_world_from_camera for scene in suite]
    measured = [home.goal(number)[1] for number in range(task.MEASURED)]
    assert not any(np.allclose(one, other) for one in measured for other in known)


def test_a_goal_of_the_measure_is_reached_by_who_goes_there(tmp_path):
    home = room.Room("pantry", NAMES, tmp_path, 25)
    goal = home.goal(1)[1]

    def straight(image):
        pose = [start_pose()]

        def act(_image):
            turn = goal[:3, :3] @ pose[0][:3, :3].T
            angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
            axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            axis = axis / max(np.linalg.norm(axis), 1e-9)
            move = np.r_[goal[:3, 3] - pose[0][:3, 3], angle * axis] / np.array(SCALE)
            move = move / max(1.0, np.abs(move).max())
            pose[0] = apply_action(pose[0], move[:3] * SCALE[0], move[3:] * SCALE[3])
            return move

        return act

    assert home.reach(1, 60, straight) < 1.0 < home.reach(1, 60, lambda _goal: lambda _image: np.zeros(6))


def test_an_episode_that_ended_early_is_kept_and_not_learnt_from(tmp_path):
    replay, rng = Replay(tmp_path, 0), np.random.default_rng(0)
    for length, shade in ((3, 0), (6, 200)):
        replay.add(Episode(np.full((length + 1, 32, 32, 3), shade, np.uint8), np.full((length, 6), 0.5, np.float32)))
    drawn = Replay(tmp_path, 2).sequences(8, 5, rng, CPU)
    assert drawn.images.unique().tolist() == [pytest.approx(200 / 255)]
    assert drawn.actions.shape == (8, 5, 6)
    assert set(drawn.actions[:, 0].unique().tolist()) == {0.0, 0.5}  # before the first image of an episode: none
    assert torch.equal(drawn.travelled[:, 1:], drawn.travelled[:, :1] + drawn.actions[:, 1:].cumsum(1))
    assert set(drawn.travelled[:, 0].unique().tolist()) == {0.0, 0.5, 1.0}  # since the episode's start
    (tmp_path / "00001.npz").write_bytes(b"no episode")
    with pytest.raises(SaccadeError, match=r"00001.npz is missing or damaged"):
        Replay(tmp_path, 2)


def test_lambda_returns_by_hand():
    rewards, worth = torch.tensor([[1.0], [2.0]]), torch.tensor([[9.0], [10.0], [20.0]])
    last = 2.0 + 0.95 * 20.0
    first = 1.0 + 0.95 * (0.05 * 10.0 + 0.95 * last)
    assert returns(rewards, worth)[:, 0].tolist() == pytest.approx([first, last])


def test_policies_learn_and_the_world_model_does_not_learn_from_them():
    torch.manual_seed(0)
    learner, generator = Learner(), torch.Generator().manual_seed(0)
    encodings, actions = torch.randn(2, 6, 256), torch.randn(2, 6, 6).tanh()
    states, posterior, prior = observe(learner.actor.model, encodings, actions, generator)
    assert states.feature.shape == (2, 6, 456)
    assert float(divergence(posterior, posterior).detach().abs().max()) == 0.0
    assert float(divergence(posterior, prior).detach().min()) > 0.0
    begin = type(states)(*(part.detach().flatten(0, 1) for part in states))
    explorer_loss(learner, begin, generator)[0].backward()
    achiever_loss(learner, begin, torch.randn(12, 32), generator)[0].backward()
    learnt = {name.split(".")[0] if not name.startswith("actor.") else name.split(".")[1]
              for name, value in learner.named_parameters() if value.grad is not None and value.grad.abs().sum() > 0}
    assert learnt == {"explorer", "achiever", "worth_explored"}


def test_the_distance_is_that_of_the_way_without_its_detours():
    """Of states and images that say where they are: the distance becomes that between them, also over episodes."""
    torch.manual_seed(0)
    travelled = (2 * torch.rand(40, 6) - 1).cumsum(0)
    known = torch.cat([travelled, torch.zeros(40, 250)], -1)
    learner = Learner()
    aim, place = learner.actor.aim, learner.actor.place
    optimizer = torch.optim.Adam([*aim.parameters(), *place.parameters()], lr=2e-3)
    losses = []
    for _ in range(200):
        loss = distance_loss(place(torch.cat([known, torch.zeros(40, 200)], -1)), aim(known), travelled, travelled)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 * losses[0]
    found = distance_of(aim(known), aim(known), all_pairs=True).detach()
    assert np.corrcoef(found.flatten(), torch.cdist(travelled, travelled).flatten())[0, 1] > 0.9
    assert distance_of(aim(known[:9]), aim(known[9:18])).tolist() == pytest.approx(
        found[:9, 9:18].diagonal().tolist(), rel=1e-2)


def test_parts_of_images_are_painted_over_with_their_commonest_colour():
    images = torch.full((64, 3, 32, 32), 0.25)
    images[:, :, 4:12, 4:12] = 0.75
    seen = patched(images, torch.Generator().manual_seed(0))
    assert set(seen.unique().tolist()) == {0.25, 0.75}
    left = (seen == 0.75).flatten(1).float().mean(1)
    whole = 64 / 1024
    assert float(left.max()) == whole
    assert 0.0 < float((left < whole).float().mean()) < 0.6


def test_the_state_is_a_fold_over_images_and_actions():
    torch.manual_seed(0)
    model = StateSpaceModel().eval()
    deterministic, prior = model(model.initial(1), torch.zeros(1, 6))
    assert prior.exp().sum(-1).detach().numpy() == pytest.approx(1.0, abs=1e-5)
    sample = likeliest(model.observe(deterministic, torch.randn(1, 256)))
    assert sample.sum() == 16
    assert model(type(model.initial(1))(deterministic, sample), torch.ones(1, 6))[0].shape == (1, 200)


@pytest.mark.parametrize("agent", ["lexa", "random-walk", "still"])
def test_an_agent_runs_on_the_bus_and_in_one_process_alike_and_is_replayed(agent, tmp_path, finished):
    logs = {}
    given = {"perception.weights": finished / "weights"} if agent == "lexa" else {}
    for kind in ("zenoh", "local"):
        config, _ = configured(None, EPISODE | {"bus.kind": kind} | given, [], agent)
        run(config, agent=agent, out=tmp_path / kind / "same", plain=True, console=Console(file=io.StringIO()))
        logs[kind] = [entry.payload for entry in RunReader(tmp_path / kind / "same" / "run.mcap").entries()
                      if entry.topic != STATUS]
    assert sorted(logs["zenoh"]) == sorted(logs["local"])
    assert_replayed(tmp_path / "local" / "same" / "run.mcap", tmp_path / "replay", "planner")
    messages = [message for _, _, message in RunReader(tmp_path / "local" / "same" / "run.mcap")]
    moves = [np.linalg.norm(message.translation_m) for message in messages if isinstance(message, Action)]
    views = [message.world_from_camera for message in messages if isinstance(message, Frame)]
    assert len(moves) == 4
    if agent == "still":
        assert moves == [0.0] * 4
        assert all(np.array_equal(view, views[0]) for view in views)
    elif agent == "random-walk":
        assert moves == [pytest.approx(0.05)] * 4
    else:
        assert 0.0 < max(moves) < 0.08 * 3 ** 0.5


def test_weights_of_another_architecture_get_one_line(tmp_path, finished):
    write_random_weights(tmp_path / "w", "pantry", NAMES)
    config, _ = configured(None, EPISODE | {"bus.kind": "local", "perception.weights": tmp_path / "w"}, [], "lexa")
    with pytest.raises(SaccadeError, match=r"architecture 'default', and this agent needs 'lexa'"):
        run(config, agent="lexa", out=tmp_path / "r", plain=True, console=Console(file=io.StringIO()))


def test_weights_that_lived_with_other_objects_get_one_line(tmp_path, finished):
    """The policy knows no names, and would walk on without a word among things that it has never seen."""
    given = {"bus.kind": "local", "scene.names": ["soup_can", "cereal_box"], "perception.weights": finished / "weights"}
    config, _ = configured(None, EPISODE | given, [], "lexa")
    with pytest.raises(SaccadeError, match="object 'cereal_box' has no weights in"):
        run(config, agent="lexa", out=tmp_path / "r", plain=True, console=Console(file=io.StringIO()))
