"""The terms of F against what they must be where the answer is known, and F over a belief that sharpens."""

import numpy as np
import pytest
import torch

from saccade.services.belief.free_energy import crop_term, gaussian_kl, identity_term, pose_term, position_term
from saccade.services.belief.position import PositionFilter
from saccade.tests.test_belief import CONFIG, TRUE, Turning, cameras, latent_of, percept


def test_gaussian_kl_equals_torchs():
    rng = np.random.default_rng(0)
    a, b = (np.cov(rng.normal(size=(3, 20))) for _ in range(2))
    mean_a, mean_b = rng.normal(size=(2, 3))
    expected = torch.distributions.kl_divergence(
        *(torch.distributions.MultivariateNormal(torch.from_numpy(m), torch.from_numpy(c))
          for m, c in ((mean_a, a), (mean_b, b))))
    assert gaussian_kl(mean_a, a, mean_b, b) == pytest.approx(float(expected))
    assert gaussian_kl(mean_a, a, mean_a, a) == pytest.approx(0.0, abs=1e-9)


def test_identity_surprises_only_when_it_changes():
    assert identity_term(0.9, 0.9) == pytest.approx(0.0)
    assert identity_term(0.99, 0.5) == pytest.approx(np.log(2) - 0.056, abs=1e-3)
    assert identity_term(1.0, 0.0) > 6


def test_a_percept_where_it_was_expected_surprises_less_than_one_elsewhere():
    before = (TRUE, np.eye(3) * 0.02 ** 2)
    camera = cameras()[0]
    expected = crop_term(percept(camera), before)
    assert crop_term(percept(camera, TRUE + np.array([0.08, 0.0, 0.0])), before) > expected + 2
    assert crop_term(percept(camera, noise=np.array([0, 0, 0.3])), before) > expected + 2


def test_the_pose_term_is_small_when_the_transition_foresaw_the_latent():
    first, second = cameras()[0], cameras()[2]
    angles = [np.arctan2(*(c[:2, 3] - TRUE[:2])[::-1]) for c in (first, second)]
    seen = [percept(c, latent=latent_of(a, 0.7)) for c, a in zip((first, second), angles, strict=True)]
    odd = percept(second, latent=latent_of(angles[1] + 2.0, 0.7))
    assert pose_term(seen[1], seen[0], TRUE, Turning(1)) < 0.2 * pose_term(odd, seen[0], TRUE, Turning(1))


def test_the_first_view_of_a_pose_surprises_as_the_standard_normal_has_it():
    seen = percept(cameras()[0], latent=latent_of(0.3, 0.7))
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(
        normal(torch.tensor(seen.latent_mean), torch.tensor(seen.latent_std)), normal(0.0, 1.0)).sum()
    assert pose_term(seen, None, TRUE, Turning(1)) == pytest.approx(float(expected), rel=1e-5)


def test_position_surprise_falls_as_the_belief_sharpens():
    rng, surprises = np.random.default_rng(0), []
    position = PositionFilter(CONFIG, rng)
    for camera in cameras():
        before = position.moments()
        position.seen(percept(camera, noise=rng.normal(0, [3, 3, 0.03])), rng)
        surprises.append(position_term(before, position.moments()))
    assert surprises[0] > 3
    assert np.mean(surprises[-3:]) < surprises[0] / 4
