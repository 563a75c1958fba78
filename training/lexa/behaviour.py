"""Explorer and achiever learn in imagination: the policies act in the world model, which stays as it is meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from saccade.services.planner.lexa import Policy, State, wish
from saccade.training.lexa.world_model import Learner, distance_of, sampled

HORIZON = 5
DISCOUNT, LAMBDA = 0.95, 0.95
ENTROPY = 1e-3
EFFORT = 0.05  # of the achiever's actions, so that it makes none that brings nothing, such as into a wall


class Imagined(NamedTuple):
    """An imagined way: features [H + 1, B, 456], and the actions between them [H, B, 6] with their entropy [H, B]."""

    features: Tensor
    actions: Tensor
    entropy: Tensor


class Frozen:
    """A network that gradients pass through, but that does not learn."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self.values = {name: value.detach() for name, value in network.named_parameters()}

    def __call__(self, *inputs):
        return functional_call(self.network, self.values, inputs)


def squashed(policy: Policy, inputs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A sample of an action [B, 6] with its gradient, and the entropy [B] of the distribution before it is
    squashed."""
    mean, std = policy(inputs)
    noise = torch.randn(mean.shape, generator=generator, device=mean.device)
    return torch.tanh(mean + std * noise), std.log().sum(-1)


def imagine(learner: Learner, start: State, act: Callable[[Tensor], tuple[Tensor, Tensor]],
            generator: torch.Generator) -> Imagined:
    """Acts for HORIZON steps from states [B, ...] of the world model."""
    model = Frozen(learner.actor.model)
    state, features = start, [start.feature]
    actions: list[Tensor] = []
    entropy: list[Tensor] = []
    for _ in range(HORIZON):
        action, spread = act(state.feature)
        deterministic, prior = model(state, action)
        state = State(deterministic, sampled(prior, generator))
        for values, value in ((features, state.feature), (actions, action), (entropy, spread)):
            values.append(value)
    return Imagined(torch.stack(features), torch.stack(actions), torch.stack(entropy))


def returns(rewards: Tensor, worth: Tensor) -> Tensor:
    """The lambda-returns [H, B] of rewards [H, B] after each action, where states are worth `worth` [H + 1, B]."""
    last, result = worth[-1], []
    for reward, value in zip(rewards.flip(0), worth[1:].flip(0), strict=True):
        last = reward + DISCOUNT * ((1 - LAMBDA) * value + LAMBDA * last)
        result.append(last)
    return torch.stack(result[::-1])


def policy_loss(imagined: Imagined, rewards: Tensor, critic: nn.Module, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """The losses of a policy and of its critic. `inputs` [H + 1, B, F] is what the critic sees."""
    worth = Frozen(critic)(inputs).float().squeeze(-1)
    gained = returns(rewards, worth)
    spread = gained.detach().std().clamp(min=0.05)
    policy = -(gained / spread).mean() - ENTROPY * imagined.entropy.mean()
    estimate = critic(inputs[:-1].detach()).float().squeeze(-1)
    return policy, F.mse_loss(estimate, gained.detach())


def explorer_loss(learner: Learner, start: State, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
    """The explorer seeks what the ensemble disagrees about."""
    imagined = imagine(learner, start, lambda feature: squashed(learner.explorer, feature, generator), generator)
    inputs = torch.cat([imagined.features[:-1], imagined.actions], dim=-1)
    guesses = torch.stack([Frozen(member)(inputs).float() for member in learner.ensemble])
    rewards = (guesses - guesses.mean(0)).square().mean(0).clamp(min=1e-12).sqrt().mean(-1)
    policy, critic = policy_loss(imagined, rewards, learner.worth_explored, imagined.features)
    return policy + critic, {"disagreement": rewards.mean()}


def achiever_loss(learner: Learner, start: State, aims: Tensor,
                  generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
    """The achiever comes nearer to what was seen, whose aims [B, 32] are given: its loss is the distance after each
    step. The distance counts the steps that are left, so there is no critic, and a short way is enough to learn from.
    """
    place = Frozen(learner.actor.place)
    imagined = imagine(
        learner, start,
        lambda feature: squashed(learner.actor.achiever, wish(feature, place(feature), aims), generator), generator)
    distance = distance_of(place(imagined.features).float(), aims.expand(HORIZON + 1, -1, -1))
    effort = imagined.actions.square().sum(-1).mean()
    policy = distance[1:].mean() + EFFORT * effort - ENTROPY * imagined.entropy.mean()
    return policy, {"distance": distance[0].mean(), "nearer": (distance[0] - distance[-1]).mean()}
