"""The world model of LEXA: what training needs beside the parts that act (Hafner et al., 2021)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.services.planner.lexa import (
    ACTIONS,
    CLASSES,
    EMBEDDED,
    FEATURE,
    Actor,
    Policy,
    State,
    StateSpaceModel,
    perceptron,
)
from saccade.training.lexa.replay import Sequences

ENSEMBLE = 5  # predictors whose disagreement is the explorer's reward
NEAR = 1e-3  # of a squared distance, so that its root has a gradient at 0
SLACK = 0.2  # a long distance may be wrong by this share of it as much as a short one by a step
SHORT = 0.3  # what a distance that is too short costs, where one that is too long costs 1
NEARBY = 5.0  # full steps from which on a distance counts less
DRAWN = 6  # images of each piece that are decoded
PRECISION = 25.0  # of the decoded images: one over the variance of a pixel's colour
PRIOR_SHARE, POSTERIOR_SHARE, FREE_NATS = 0.5, 0.1, 1.0  # of the KL divergence (Hafner et al., 2023)


class ImageDecoder(nn.Module):
    """Features [B, 456] -> images [B, 3, 32, 32]."""

    def __init__(self) -> None:
        super().__init__()
        self.start = nn.Sequential(nn.Linear(FEATURE, 48 * 64), nn.SiLU(), nn.Unflatten(1, (48, 8, 8)))
        self.layers = nn.Sequential(nn.Conv2d(48, 48, 3, padding=1), nn.SiLU(), nn.Conv2d(48, 48, 3, padding=1),
                                    nn.PixelShuffle(4))  # a pixel shuffle is faster than transposed convolutions

    def forward(self, feature: Tensor) -> Tensor:
        return self.layers(self.start(feature)).float() + 0.5


class Learner(nn.Module):
    """All networks of a training run: those that act, and the decoder, the ensemble, the explorer and its critic."""

    def __init__(self) -> None:
        super().__init__()
        self.actor, self.decoder = Actor(), ImageDecoder()
        self.ensemble = nn.ModuleList(perceptron(FEATURE + ACTIONS, EMBEDDED) for _ in range(ENSEMBLE))
        self.explorer = Policy(FEATURE)
        self.worth_explored = perceptron(FEATURE, 1)


def sampled(log_shares: Tensor, generator: torch.Generator) -> Tensor:
    """A sample of each variable as ones and zeros [B, 256], with the gradient of the probabilities."""
    shares = log_shares.exp()
    uniform = torch.rand(shares.shape, generator=generator, device=shares.device)
    drawn = (log_shares.detach() - (-uniform.clamp(min=1e-20).log()).log()).argmax(-1)  # the Gumbel-max trick
    return (F.one_hot(drawn, CLASSES) + shares - shares.detach()).flatten(-2)


def patched(images: Tensor, generator: torch.Generator) -> Tensor:
    """Half of the images [B, 3, S, S], each with up to two rectangles painted over with its commonest colour.

    A goal image may show less than the room has in it. So an aim must not depend on every part of an image.
    """
    count, side = len(images), images.shape[-1]
    along = torch.arange(side, device=images.device)
    pixels = images.flatten(2)
    plain = pixels.median(-1).values[:, :, None, None]
    result = images
    for _ in range(2):
        drawn = torch.rand(5, count, 1, generator=generator, device=images.device)
        first, extent = drawn[:2] * 1.4 * side - 0.4 * side, (0.15 + 0.6 * drawn[2:4]) * side
        down, across = ((along >= begin) & (along < begin + length) for begin, length in zip(first, extent,
                                                                                             strict=True))
        cut = (down[:, :, None] & across[:, None, :] & (drawn[4] < 0.3)[:, :, None])[:, None]
        result = torch.where(cut, plain, result)
    return result


def observe(model: StateSpaceModel, encodings: Tensor, actions: Tensor,
            generator: torch.Generator) -> tuple[State, Tensor, Tensor]:
    """Folds sequences of encodings [B, L, 256] and of the actions before them [B, L, 6].

    Returns the states (each part [B, L, ...]) and the log probabilities of posterior and prior [B, L, 16, 16].
    """
    state = model.initial(len(encodings), encodings.device)
    deterministic: list[Tensor] = []
    samples: list[Tensor] = []
    posteriors: list[Tensor] = []
    priors: list[Tensor] = []
    for n in range(encodings.shape[1]):
        kept, prior = model(state, actions[:, n])
        posterior = model.observe(kept, encodings[:, n])
        state = State(kept, sampled(posterior, generator))
        for values, value in ((deterministic, kept), (samples, state.sample), (posteriors, posterior),
                              (priors, prior)):
            values.append(value)
    return (State(torch.stack(deterministic, 1), torch.stack(samples, 1)), torch.stack(posteriors, 1),
            torch.stack(priors, 1))


def divergence(posterior: Tensor, prior: Tensor) -> Tensor:
    """KL[posterior || prior] in nats [...], from log probabilities [..., 16, 16], summed over the variables."""
    return (posterior.exp() * (posterior - prior)).sum((-1, -2))


def model_loss(learner: Learner, batch: Sequences, encodings: Tensor, states: State, posterior: Tensor,
               prior: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of the world model and its parts: the error of some images, and the KL terms."""
    count, length = encodings.shape[:2]
    chosen = torch.rand(count, length, generator=generator, device=encodings.device).argsort(1)[:, :DRAWN]
    rows = torch.arange(count, device=encodings.device)[:, None]
    drawn = learner.decoder(states.feature[rows, chosen].flatten(0, 1))
    image = 0.5 * PRECISION * (drawn - batch.images[rows, chosen].flatten(0, 1)).square().sum((1, 2, 3)).mean()
    forward = divergence(posterior.detach(), prior).clamp(min=FREE_NATS).mean()
    backward = divergence(posterior, prior.detach()).clamp(min=FREE_NATS).mean()
    return image + PRIOR_SHARE * forward + POSTERIOR_SHARE * backward, {"image": image, "kl": forward}


def ensemble_loss(learner: Learner, states: State, actions: Tensor, encodings: Tensor) -> Tensor:
    """How badly the members of the ensemble predict the next encoding from a state and an action."""
    inputs = torch.cat([states.feature[:, :-1].detach(), actions[:, 1:]], dim=-1).flatten(0, 1)
    target = encodings[:, 1:].detach().flatten(0, 1).float()
    return torch.stack([F.mse_loss(member(inputs).float(), target) for member in learner.ensemble]).sum()


def distance_loss(places: Tensor, aims: Tensor, travelled: Tensor, aimed: Tensor) -> Tensor:
    """The error of the distances from places of states and from aims of images to these aims.

    Two images are as far apart as the sum of the actions between them is long: a detour does not count. Between two
    episodes the way leads over the start, which they share. Where something held the camera up, the sum is too long; so
    a distance that is shorter than it costs less than one that is longer, and long ways count less than short ones.
    `travelled` [N, 6] and `aimed` [M, 6] are the sums of the actions since the episode's start for places [N, 32] and
    aims [M, 32].
    """
    loss = torch.zeros((), device=places.device)
    for here, steps in ((places, travelled), (aims, aimed)):
        true = torch.cdist(steps, aimed)
        error = (distance_of(here, aims, all_pairs=True) - true) / (1 + SLACK * true)
        costs = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=0.5)
        weights = torch.where(error > 0, 1.0, SHORT) / (1 + true / NEARBY)
        loss = loss + (weights * costs).sum() / weights.sum().detach()
    return loss


def distance_of(place: Tensor, aim: Tensor, *, all_pairs: bool = False) -> Tensor:
    """The distance [...] in full steps of places and aims [..., 32]; with `all_pairs` [..., N, M] of N and M."""
    if not all_pairs:
        return ((place - aim).square().sum(-1) + NEAR).sqrt()
    inner = place @ aim.transpose(-1, -2)
    squares = place.square().sum(-1)[..., None] + aim.square().sum(-1)[..., None, :] - 2 * inner
    return (squares.clamp(min=0.0) + NEAR).sqrt()
