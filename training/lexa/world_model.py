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
PRIOR_SHARE, POSTERIOR_SHARE, FREE_NATS = 0.5, 0.1, 1.0  # of the KL divergence (Hafner et al., 2023)


class ImageDecoder(nn.Module):
    """Features [B, 456] -> images [B, 3, 64, 64]."""

    def __init__(self) -> None:
        super().__init__()
        self.start = nn.Sequential(nn.Linear(FEATURE, 128 * 16), nn.SiLU(), nn.Unflatten(1, (128, 4, 4)))
        layers: list[nn.Module] = []
        for before, after in ((128, 64), (64, 32), (32, 16)):  # pixel shuffles are faster than transposed convolutions
            layers += [nn.Conv2d(before, 4 * after, 3, padding=1), nn.PixelShuffle(2), nn.SiLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(16, 12, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, feature: Tensor) -> Tensor:
        return self.layers(self.start(feature)).float() + 0.5


class Learner(nn.Module):
    """All networks of a training run: those that act, and the decoder, the encoding's prediction, the ensemble, the
    distance, the explorer and two critics."""

    def __init__(self) -> None:
        super().__init__()
        self.actor, self.decoder = Actor(), ImageDecoder()
        self.encoding = perceptron(FEATURE, EMBEDDED)
        self.ensemble = nn.ModuleList(perceptron(FEATURE + ACTIONS, EMBEDDED) for _ in range(ENSEMBLE))
        self.distance = perceptron(2 * EMBEDDED, 1)
        self.explorer = Policy(FEATURE)
        self.worth_explored, self.worth_achieved = perceptron(FEATURE, 1), perceptron(FEATURE + EMBEDDED, 1)


def sampled(log_shares: Tensor, generator: torch.Generator) -> Tensor:
    """A sample of each variable as ones and zeros [B, 256], with the gradient of the probabilities."""
    shares = log_shares.exp()
    uniform = torch.rand(shares.shape, generator=generator, device=shares.device)
    drawn = (log_shares.detach() - (-uniform.clamp(min=1e-20).log()).log()).argmax(-1)  # the Gumbel-max trick
    return (F.one_hot(drawn, CLASSES) + shares - shares.detach()).flatten(-2)


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
               prior: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of the world model and its parts: the image's error, the KL terms, and the encoding's error."""
    features = states.feature.flatten(0, 1)
    image = 0.5 * ((learner.decoder(features) - batch.images.flatten(0, 1)) ** 2).sum((1, 2, 3)).mean()
    forward = divergence(posterior.detach(), prior).clamp(min=FREE_NATS).mean()
    backward = divergence(posterior, prior.detach()).clamp(min=FREE_NATS).mean()
    encoding = F.mse_loss(learner.encoding(features.detach()).float(), encodings.detach().flatten(0, 1).float())
    loss = image + PRIOR_SHARE * forward + POSTERIOR_SHARE * backward + encoding
    return loss, {"image": image, "kl": forward, "encoding": encoding}


def ensemble_loss(learner: Learner, states: State, actions: Tensor, encodings: Tensor) -> Tensor:
    """How badly the members of the ensemble predict the next encoding from a state and an action."""
    inputs = torch.cat([states.feature[:, :-1].detach(), actions[:, 1:]], dim=-1).flatten(0, 1)
    target = encodings[:, 1:].detach().flatten(0, 1).float()
    return torch.stack([F.mse_loss(member(inputs).float(), target) for member in learner.ensemble]).sum()


def distance_loss(learner: Learner, encodings: Tensor, generator: torch.Generator) -> Tensor:
    """The error of the temporal distance: the share of a sequence's length between two of its images, in either order;
    1 between images of different sequences."""
    known = encodings.detach()
    count, length = known.shape[:2]

    def drawn() -> Tensor:
        return torch.randint(length, (count, length), generator=generator, device=known.device)

    first, second = drawn(), drawn()
    rows = torch.arange(count, device=known.device)[:, None]
    near = (first - second).abs() / (length - 1)
    pairs = [torch.cat([known[rows, first], known[rows, second]], -1),
             torch.cat([known[rows, first], known.roll(1, 0)[rows, second]], -1)]
    return sum((F.mse_loss(distance_of(learner.distance, pair), target)
                for pair, target in zip(pairs, (near, torch.ones_like(near)), strict=True)), torch.zeros(()))


def distance_of(network: nn.Module, pairs: Tensor) -> Tensor:
    """The temporal distance [...] of pairs of encodings [..., 512], from 0 to about 1."""
    return F.softplus(network(pairs).float().squeeze(-1))
