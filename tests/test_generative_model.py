"""The CCN's parts: shapes, densities, and the batched evaluation of K networks against a loop over them."""

import numpy as np
import pytest
import torch

from saccade.services.perception.networks import CELLS, MASK_PX, Extraction, Identity, tally
from saccade.shared.config import WEIGHTS
from saccade.shared.model import drawing, latent
from saccade.shared.model.generative_model import (
    CCN,
    LATENT,
    Encoder,
    Stacked,
    Transition,
    decoder_of,
    kl_divergence,
    log_density,
    transition_of,
)
from saccade.shared.model.weights import Weights


@pytest.mark.parametrize("count", [1, 2, 5])
def test_stacked_networks_equal_a_loop_over_them(count):
    torch.manual_seed(0)
    for make, inputs in ((Encoder, (torch.rand(count, 3, 4, 64, 64),)), (Identity, (torch.rand(count, 2, 4, 64, 64),)),
                         (Transition, (torch.randn(count, 7, LATENT), torch.randn(count, 7, 2)))):
        stacked = Stacked([make() for _ in range(count)])
        fast, slow = stacked(*inputs), stacked.one_by_one(*inputs)
        for a, b in zip(fast, slow, strict=True):
            assert a.shape[:2] == inputs[0].shape[:2]
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_ccn_shapes_and_positive_deviations():
    ccn = CCN()
    mean, std = ccn.encoder(torch.rand(3, 4, 64, 64))
    moved, moved_std = ccn.transition(mean, torch.zeros(3, 2))
    assert mean.shape == std.shape == moved.shape == (3, LATENT)
    assert (std > 0).all()
    assert (moved_std > 0).all()
    assert ccn.decoder(mean).shape == (3, 3, 64, 64)


def test_a_full_turn_is_no_turn():
    transition, latent = Transition(), torch.randn(4, LATENT)
    turn = torch.tensor([[2 * torch.pi, 0.3]]).expand(4, 2)
    still = torch.tensor([[0.0, 0.3]]).expand(4, 2)
    torch.testing.assert_close(transition(latent, turn)[0], transition(latent, still)[0], rtol=1e-4, atol=1e-5)


def test_gaussian_formulas_equal_those_of_torch():
    mean, std, x = torch.randn(6, LATENT), torch.rand(6, LATENT) + 0.1, torch.randn(6, LATENT)
    other, other_std = torch.randn(6, LATENT), torch.rand(6, LATENT) + 0.1
    p, q = torch.distributions.Normal(mean, std), torch.distributions.Normal(other, other_std)
    torch.testing.assert_close(log_density(x, mean, std), p.log_prob(x).sum(-1))
    expected = torch.distributions.kl_divergence(p, q).sum(-1)
    torch.testing.assert_close(kl_divergence(mean, std, other, other_std), expected)


@pytest.mark.parametrize("folder", ["pantry", "ycb", "ycb-paper"])
def test_what_belief_does_in_numpy_is_what_was_trained_in_torch(folder):
    weights = Weights(WEIGHTS / folder)
    name = weights.names[0]
    network = weights.fill(transition_of(weights.architecture), name, latent.PREFIX)
    rng = np.random.default_rng(0)
    start, goal = (rng.normal(size=LATENT).astype(np.float32) for _ in range(2))
    moves = rng.uniform(-3, 3, (200, 2)).astype(np.float32)
    mean, std = latent.LatentTransition(weights, name)(start, moves)
    with torch.inference_mode():
        expected = network(torch.from_numpy(start).expand(200, -1), torch.from_numpy(moves))
    for ours, theirs in zip((mean, std), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(latent.log_density(goal, mean, std), log_density(torch.from_numpy(goal), *expected),
                               rtol=1e-3)
    prior = (np.zeros_like(mean), np.ones_like(std))
    np.testing.assert_allclose(latent.kl_divergence((mean, std), prior), kl_divergence(*expected, 0.0, 1.0), rtol=1e-3)


@pytest.mark.parametrize("folder", ["pantry", "ycb", "ycb-paper"])
def test_what_the_viewer_draws_in_numpy_is_what_was_trained_in_torch(folder):
    weights = Weights(WEIGHTS / folder)
    start = np.random.default_rng(1).normal(size=LATENT).astype(np.float32)
    for name in weights.names:
        network = weights.fill(decoder_of(weights.architecture), name, drawing.PREFIX)
        with torch.inference_mode():
            expected = network(torch.from_numpy(start)[None])[0]
        np.testing.assert_allclose(drawing.LatentDecoder(weights, name)(start), expected, atol=2e-5)


def test_votes_of_the_cells_that_see_the_object_decide():
    logits, votes = torch.full((1, CELLS, CELLS), -9.0), torch.randn(1, 3, CELLS, CELLS)
    logits[0, 10, 20] = 6.0
    logits[0, 11, 20] = 6.0
    for row in (10, 11):  # both say: centre at (0.5, 0.25), scale e^0.7
        votes[0, :, row, 20] = torch.tensor([0.5 - 20.5 / CELLS, 0.25 - (row + 0.5) / CELLS, 0.7])
    _, center, log_scale = tally(logits, votes)
    torch.testing.assert_close(center[0], torch.tensor([0.5, 0.25]), atol=2e-3, rtol=0)
    assert abs(float(log_scale[0]) - 0.7) < 5e-3


def test_extraction_gives_masks_and_votes_for_every_object():
    masks, logits, votes = Extraction(3)(torch.rand(2, 3, 120, 120))
    assert masks.shape == (2, 3, MASK_PX, MASK_PX)
    assert logits.shape == (2, 3, CELLS, CELLS)
    assert votes.shape == (2, 3, 3, CELLS, CELLS)
