"""The paper's own networks: layer for layer as in its tables, trained in two phases, used by the same services."""

import json
from itertools import pairwise

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

from saccade.app.cli.train import train as train_command
from saccade.services.belief.core import BeliefFilter
from saccade.services.perception.core import SceneCCN, build, model_of
from saccade.services.perception.paper import (
    CROP_SIDE_M,
    MaskNetwork,
    PaperExtraction,
    PaperSceneCCN,
    SpatialTransformer,
    median_pool,
    spatial_transform,
)
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.model.generative_model import CCN, LATENT, PaperDecoder, Stacked, transition_of
from saccade.shared.model.weights import MANIFEST, Weights
from saccade.shared.world.geometry import INTRINSICS_PX
from saccade.tests.fakes.training import assert_same_checkpoint, interrupt_and_resume
from saccade.tests.fakes.weights import write_random_weights
from saccade.training.ccn import goal_search_errors
from saccade.training.checkpoints import ccn_of
from saccade.training.dataset import load_views
from saccade.training.paper_data import CleanViews, PaperFrames
from saccade.training.part import Trainer
from saccade.training.run import export, start, train
from saccade.training.settings import TrainingConfig

NAMES = ("soup_can", "rice_box")
TINY = TrainingConfig(objects="pantry", names=NAMES, views=24, steps_ccn=4, steps_extraction=4, batch_ccn=4,
                      batch_extraction=4, checkpoint_every=2, device="cpu", architecture="paper")
IMAGE = np.random.default_rng(0).integers(0, 256, (480, 480, 3)).astype(np.uint8)
UP = (0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A whole tiny run of both phases, by processes, as a user would start it."""
    run_dir = tmp_path_factory.mktemp("run")
    train(run_dir, TINY, jobs=2, console=Console(quiet=True))
    return run_dir


@pytest.fixture(scope="module")
def weights(finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    export(finished, folder)
    return Weights(folder)


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def convolution(channels_in, channels_out, side):
    return channels_out * (channels_in * side ** 2 + 1)


def linear(*sizes):
    return sum(b * (a + 1) for a, b in pairwise(sizes))


def test_every_network_has_the_parameters_of_its_table():
    extraction, ccn = PaperExtraction(), CCN("paper")
    four = convolution(3, 8, 4) + convolution(8, 16, 4) + convolution(16, 32, 4) + convolution(32, 64, 4)
    assert count(extraction.mask) == 23777 == (
        convolution(3, 16, 1) + convolution(16, 32, 3) + convolution(32, 64, 3) + convolution(64, 1, 3))
    assert count(extraction.transformer) == 828035 == linear(3 * 32 * 32, 256, 128, 64, 3)
    assert count(extraction.identity) == 43769 == four + linear(256, 1)
    assert count(ccn.encoder) == 47624 == four + linear(256, 2 * LATENT)
    assert count(ccn.transition) == 104336 == linear(LATENT + 2, 128, 256, 256, 2 * LATENT)
    assert count(ccn.decoder) == 334051 == (
        linear(8, 4096) + 2 * convolution(64, 64, 5) + convolution(64, 32, 6) + convolution(32, 16, 6)
        + convolution(16, 3, 1))
    assert 5 * 2 * (count(extraction) + count(ccn)) < 15e6  # bytes of five objects in half precision


def test_the_decoder_has_the_sizes_of_its_table():
    sizes, decoder = [], PaperDecoder()
    for layer in decoder.convolutions:
        if not isinstance(layer, nn.LeakyReLU):
            layer.register_forward_hook(lambda module, inputs, output: sizes.append(tuple(output.shape[1:])))
    decoder(torch.randn(2, LATENT))
    assert sizes == [(64, 4, 4), (64, 17, 17), (64, 13, 13), (64, 35, 35), (32, 30, 30), (32, 69, 69), (16, 64, 64),
                     (3, 64, 64)]


def test_the_kinds_of_layers_are_those_of_the_tables():
    def kinds(module):
        return [type(layer).__name__ for layer in module]

    assert kinds(MaskNetwork().convolutions) == ["Conv2d", "LeakyReLU"] * 3 + ["Conv2d"]
    assert kinds(SpatialTransformer().layers) == ["Flatten"] + ["Linear", "LeakyReLU"] * 3 + ["Linear", "ELU"]
    assert kinds(transition_of("paper").layers) == ["Linear", "LeakyReLU"] * 3 + ["Linear"]
    assert kinds(CCN("paper").encoder.convolutions) == ["Conv2d", "LeakyReLU"] * 4 + ["Flatten"]


def test_the_median_is_that_of_the_pixels_around():
    image = torch.rand(2, 1, 9, 9)
    pooled = median_pool(image, 5)
    assert pooled.shape == image.shape
    assert float(pooled[1, 0, 4, 6]) == float(image[1, 0, 2:7, 4:9].median())


def test_the_scale_follows_the_paper_and_never_meets_the_pole():
    network = SpatialTransformer()
    for raw, scale in ((0.3, 1 / (3.8 * 0.3 + 0.2)), (-0.0526, 5.0), (-4.0, 5.0)):
        with torch.no_grad():
            network.layers[-2].weight.zero_()
            network.layers[-2].bias.copy_(torch.tensor([0.4, -0.2, raw]))
        center, found = network(torch.rand(1, 3, 480, 480))
        assert float(found.detach()) == pytest.approx(scale, rel=1e-5)
        assert center[0].tolist() == pytest.approx([0.4, np.exp(-0.2) - 1])
    network.zero_grad()
    found.sum().backward()
    assert float(network.layers[-2].bias.grad[2]) < 0  # there is a way back


@pytest.mark.parametrize("side", [120, 480])
def test_a_crop_is_what_centre_and_scale_say(side):
    image = torch.rand(1, 1, side, side)
    whole = spatial_transform(image, torch.zeros(1, 2), torch.ones(1))
    assert whole.shape == (1, 1, 64, 64)
    assert float((whole.mean() - image.mean()).abs()) < 0.01
    image[:, :, :, side // 2:] = 0.0
    image[:, :, side // 2:] = 0.0
    corner = spatial_transform(image, torch.tensor([[-0.5, -0.5]]), torch.tensor([0.5]))
    assert float((corner.mean() - image[..., :side // 2, :side // 2].mean()).abs()) < 0.02
    beyond = spatial_transform(torch.ones(1, 1, side, side), torch.tensor([[1.0, 0.0]]), torch.ones(1))
    assert float(beyond.mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("objects", [1, 3])
def test_all_objects_together_equal_one_by_one(objects):
    torch.manual_seed(0)
    stacked = Stacked([PaperExtraction() for _ in range(objects)])
    image = torch.rand(objects, 2, 3, 120, 120)
    for a, b in zip(stacked(image), stacked.one_by_one(image), strict=True):
        assert a.shape[:2] == (objects, 2)
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_perception_sees_all_objects_as_one_by_one(weights):
    fast = PaperSceneCCN(weights, NAMES).see(IMAGE, INTRINSICS_PX, UP)
    slow = PaperSceneCCN(weights, NAMES, one_by_one=True).see(IMAGE, INTRINSICS_PX, UP)
    assert fast.latent_mean.shape == (2, LATENT)
    assert fast.camera_from_object is None
    for name, value in vars(fast).items():
        if value is None:
            continue
        assert np.allclose(value, getattr(slow, name), rtol=1e-4, atol=1e-4), name
        assert np.isfinite(value).all()


def test_the_manifest_chooses_the_networks_of_perception_and_belief(weights, tmp_path):
    manifest = json.loads((weights.folder / MANIFEST).read_text())
    assert manifest["architecture"] == manifest["training"]["architecture"] == "paper"
    assert {card.crop_side_m for card in weights.cards} == {CROP_SIDE_M}
    assert set(weights.calibration) == {f"{n}.{what}" for n in NAMES for what in ("pixel_std", "log_scale_std")}
    config = Config().with_values({"perception.weights": weights.folder, "scene.names": list(NAMES)})
    assert isinstance(build(config).model, PaperSceneCCN)
    assert not BeliefFilter(config, NAMES).transitions["soup_can"].periodic
    write_random_weights(tmp_path, "pantry", NAMES)
    assert Weights(tmp_path).architecture == "default"
    assert isinstance(model_of(Weights(tmp_path), NAMES, 2), SceneCCN)


def test_an_unknown_architecture_is_told(tmp_path):
    write_random_weights(tmp_path, "pantry", NAMES)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {"architecture": "next"}))
    with pytest.raises(SaccadeError, match="'next'"):
        Weights(tmp_path)


@pytest.mark.parametrize("part", ["soup_can", "soup_can.extraction"])
def test_an_interrupted_run_goes_on_exactly(finished, tmp_path, part):

    torch.set_num_threads(1)  # as the processes do: more threads add in another order
    (tmp_path / "views").symlink_to(finished / "views")
    if part != "soup_can":
        (tmp_path / "soup_can").symlink_to(finished / "soup_can")
    start(tmp_path, TINY)
    interrupt_and_resume(tmp_path, part, before_step=3)  # after the checkpoint at 2, before the next
    assert_same_checkpoint(finished, tmp_path, part)


def test_a_run_leaves_losses_and_pictures(finished):
    for part in TINY.parts:
        lines = (finished / part / "losses.jsonl").read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines] == [2, 4]
        assert (finished / part / "samples.png").stat().st_size > 1000


def test_phase_two_waits_for_phase_one(finished, tmp_path):
    assert TINY.needs("soup_can.extraction") == "soup_can"
    assert TINY.needs("soup_can") is None
    (tmp_path / "views").symlink_to(finished / "views")
    start(tmp_path, TINY)
    with pytest.raises(SaccadeError, match="not trained yet"):
        Trainer(tmp_path, "soup_can.extraction")


def test_phase_two_can_begin_with_the_ccns_of_other_weights(finished, weights, tmp_path):
    config = TINY.model_copy(update={"ccns": str(weights.folder)})
    assert config.parts == ("soup_can.extraction", "rice_box.extraction")
    (tmp_path / "views").symlink_to(finished / "views")
    train(tmp_path, config, jobs=2, console=Console(quiet=True))
    export(tmp_path, tmp_path / "weights")
    again = Weights(tmp_path / "weights")
    for name in NAMES:
        assert again.hashes[f"{name}.safetensors"] == weights.hashes[f"{name}.safetensors"]
        assert again.manifest["losses"][name] == weights.manifest["losses"][name]
    write_random_weights(tmp_path / "default", "pantry", NAMES)
    with pytest.raises(SaccadeError, match="architecture 'default', not 'paper'"):
        ccn_of(tmp_path, TINY.model_copy(update={"ccns": str(tmp_path / "default")}), "soup_can")


def test_phase_two_can_go_on_from_the_networks_of_other_weights(finished, weights, tmp_path):
    (tmp_path / "views").symlink_to(finished / "views")
    start(tmp_path, TINY.model_copy(update={"ccns": str(weights.folder), "begin_with": str(weights.folder)}))
    part = "soup_can.extraction"
    trainer = Trainer(tmp_path, part)
    before = weights.state(part)
    assert trainer.step == 0
    assert all(np.array_equal(value.numpy(), before[key]) for key, value in trainer.task.module.state_dict().items())
    assert "kl" in trainer.task.loss(0)[1]  # the crop shows something from the first step on


def test_the_measure_of_a_ccn_asks_only_for_displacements_that_it_was_trained_on(finished):
    """The paper's transition takes the azimuth as a number: beyond half a turn it has seen none."""
    asked = []
    ccn = CCN("paper").eval()
    ccn.transition.register_forward_hook(lambda module, inputs, output: asked.append(inputs[1]))
    clean = CleanViews(load_views(finished, "soup_can"), torch.device("cpu"))
    goal_search_errors(ccn, clean, torch.arange(24), torch.Generator().manual_seed(0), pairs=8)
    assert float(torch.cat(asked)[:, 0].abs().max()) <= np.pi + 1e-5


def test_the_paper_has_its_own_defaults_and_ours_are_as_they_were():
    paper = TrainingConfig(names=NAMES, architecture="paper")
    assert (paper.batch_ccn, paper.rate_ccn, paper.batch_extraction, paper.rate_extraction) == (150, 5e-4, 100, 1.5e-3)
    assert TrainingConfig(names=NAMES, architecture="paper", batch_ccn=20).batch_ccn == 20
    assert TrainingConfig.model_validate_json(paper.model_dump_json()) == paper
    ours = TrainingConfig(names=NAMES)
    assert (ours.batch_ccn, ours.architecture, ours.needs("extraction")) == (32, "default", None)
    assert {"architecture", "kl_extraction", "ccns"}.isdisjoint(ours.model_dump(mode="json"))
    assert TrainingConfig.model_validate_json(ours.model_dump_json()) == ours


def test_the_composed_images_agree_with_their_labels(finished):
    """Cut out at the true centre and scale, an unhidden object looks as its clean view does."""
    views = [load_views(finished, name) for name in NAMES]
    clean, index = CleanViews(views[0], torch.device("cpu")), torch.arange(24).repeat(6)
    frames = PaperFrames(views[0], views[1:], torch.device("cpu"))
    batch = frames.compose(index, torch.Generator().manual_seed(0))
    assert 0.2 < float((batch.visible == 0).float().mean()) < 0.45
    assert float(batch.mask[batch.visible[:, 0] == 0].sum()) == 0.0
    assert -1.27 < float(batch.log_scale.min()) < -1.0 < 1.0 < float(batch.log_scale.max()) < 1.39
    crops = spatial_transform(batch.image * batch.mask, batch.center[:, 0] * 2 - 1, batch.log_scale[:, 0].exp())
    chosen = (batch.visible[:, 0] > 0.98) & (batch.visible[:, 0] < 1.1) & (batch.log_scale[:, 0].abs() < 0.7)
    assert int(chosen.sum()) >= 5
    assert float((crops - clean.clean(index))[chosen].abs().mean()) < 0.02
    assert float((crops - clean.clean(index.roll(1)))[chosen].abs().mean()) > float(
        (crops - clean.clean(index))[chosen].abs().mean())


@pytest.mark.parametrize(("architecture", "folder"), [("default", "pantry"), ("paper", "pantry-paper")])
def test_the_command_keeps_the_architectures_apart(monkeypatch, architecture, folder):
    called = []
    monkeypatch.setattr("saccade.training.run.train", lambda run_dir, settings, **_: called.append(
        (run_dir.name, settings)))
    monkeypatch.setattr("saccade.training.run.export", lambda run_dir, target: called.append(
        (run_dir.name, target.name)))
    train_command(objects="pantry", names=",".join(NAMES), architecture=architecture)
    (run_name, settings), exported = called
    assert (run_name, settings.architecture, exported) == (folder, architecture, (folder, folder))
