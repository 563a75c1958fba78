"""LEXA, the Latent Explorer Achiever (Mendonca et al., 2021): it reaches the goal image by a policy in a latent space.

It knows no objects and no poses: images go in, actions come out. A recurrent state-space model (Hafner et al., 2021)
folds the images and actions of the episode into a state, and the achiever, a policy that is given the goal's encoding,
acts on this state. `training/lexa` trains it in one room. The weights' manifest says "architecture": "lexa".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from saccade.services.planner.outputs import step_from
from saccade.shared.bus.messages import Frame, Goal
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.model.weights import Weights

SERVICE = Service("planner", inputs=(FRAME, GOAL), trigger=FRAME, outputs=(PLAN, ACTION))

IMAGE_PX = 32
EMBEDDED, DETERMINISTIC, GROUPS, CLASSES = 256, 200, 16, 16
FEATURE = DETERMINISTIC + GROUPS * CLASSES
PLACE = 32  # numbers of a place in the map of distances
ACTIONS = 6
SCALE = (0.06, 0.06, 0.06, 0.1, 0.1, 0.1)  # an action of 1 in metres and radians
GOING, AROUND = 30, 20  # steps towards a goal, and then by chance around it, again and again
BEND = 1.5  # the mean of an action is bent to stay within this, where the gradient of tanh has not vanished
UNIFORM = 0.01  # share of a uniform distribution in every categorical one


class State(NamedTuple):
    """The state of the model: its deterministic part [B, 200], and its sample of 16 variables of 16 classes
    [B, 256]."""

    deterministic: Tensor
    sample: Tensor

    @property
    def feature(self) -> Tensor:
        """Both parts [B, 456]."""
        return torch.cat([self.deterministic, self.sample], dim=-1)


class ImageEncoder(nn.Module):
    """Images [B, 3, 32, 32] (0 to 1) -> encodings [B, 256]."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(3, 64, 6, 4, padding=1), nn.SiLU(), nn.Conv2d(64, 128, 3, 2, padding=1),
                                    nn.SiLU(), nn.Flatten(), nn.Linear(128 * 16, EMBEDDED), nn.LayerNorm(EMBEDDED))

    def forward(self, image: Tensor) -> Tensor:
        return self.layers(image - 0.5)


def perceptron(inputs: int, outputs: int, hidden: int = 256, depth: int = 2) -> nn.Sequential:
    """Fully connected layers with normalisation."""
    layers: list[nn.Module] = []
    for n in range(depth):
        layers += [nn.Linear(inputs if n == 0 else hidden, hidden), nn.LayerNorm(hidden), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(hidden, outputs))


class StateSpaceModel(nn.Module):
    """The recurrent state-space model with categorical variables."""

    def __init__(self) -> None:
        super().__init__()
        self.enter = nn.Sequential(nn.Linear(GROUPS * CLASSES + ACTIONS, DETERMINISTIC), nn.LayerNorm(DETERMINISTIC),
                                   nn.SiLU())
        self.recurrent = nn.GRUCell(DETERMINISTIC, DETERMINISTIC)
        self.prior = perceptron(DETERMINISTIC, GROUPS * CLASSES, depth=1)
        self.posterior = perceptron(DETERMINISTIC + EMBEDDED, GROUPS * CLASSES, depth=1)

    def initial(self, count: int, device: torch.device | str = "cpu") -> State:
        """The state before the first image."""
        return State(torch.zeros(count, DETERMINISTIC, device=device), torch.zeros(count, GROUPS * CLASSES,
                                                                                  device=device))

    def forward(self, state: State, action: Tensor) -> tuple[Tensor, Tensor]:
        """The deterministic part after an action [B, 6], and the log probabilities of the prior [B, 16, 16]."""
        deterministic = self.recurrent(self.enter(torch.cat([state.sample, action], dim=-1)), state.deterministic)
        return deterministic, _log_shares(self.prior(deterministic))

    def observe(self, deterministic: Tensor, encoding: Tensor) -> Tensor:
        """The log probabilities of the posterior [B, 16, 16] after an image with this encoding [B, 256]."""
        return _log_shares(self.posterior(torch.cat([deterministic, encoding], dim=-1)))


def _log_shares(logits: Tensor) -> Tensor:
    shares = logits.unflatten(-1, (GROUPS, CLASSES)).float().softmax(-1)
    return ((1 - UNIFORM) * shares + UNIFORM / CLASSES).log()


def likeliest(log_shares: Tensor) -> Tensor:
    """The likeliest class of each variable, as ones and zeros [B, 256]."""
    return F.one_hot(log_shares.argmax(-1), CLASSES).float().flatten(-2)


class Policy(nn.Module):
    """Features [B, F] -> mean and standard deviation of an action before it is squashed, each [B, 6]."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = perceptron(inputs, 2 * ACTIONS)

    def forward(self, feature: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.layers(feature).float().chunk(2, dim=-1)
        return BEND * torch.tanh(mean / BEND), F.softplus(raw) + 0.1


class Actor(nn.Module):
    """What acts: the encoder, the model, the achiever, and the map of distances, in which `place` says where a state
    is and `aim` where a goal image is. The distance of two places [32] is the number of full steps between them."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.model = ImageEncoder(), StateSpaceModel()
        self.place, self.aim = perceptron(FEATURE, PLACE), perceptron(EMBEDDED, PLACE)
        self.achiever = Policy(FEATURE + 2 * PLACE)

    def fold(self, state: State, action: Tensor, image: Tensor, pick: Callable[[Tensor], Tensor]) -> State:
        """The state after an action [B, 6] and the image [B, 3, 32, 32] that followed. `pick` chooses the sample from
        the log probabilities of the posterior."""
        deterministic, _ = self.model(state, action)
        return State(deterministic, pick(self.model.observe(deterministic, self.encoder(image))))

    def towards(self, state: State, aim: Tensor) -> tuple[Tensor, Tensor]:
        """What `Policy` says for the way from a state to an aim [B, 32]."""
        return self.achiever(wish(state.feature, self.place(state.feature), aim))


def wish(feature: Tensor, place: Tensor, aim: Tensor) -> Tensor:
    """What the achiever is given [..., 520]: the feature, its place and the aim [..., 32], seen from the place."""
    return torch.cat([feature, aim, aim - place], dim=-1)


def small(rgb: NDArray[np.uint8]) -> Tensor:
    """An image [H, W, 3] as the network sees it [1, 3, 32, 32]."""
    image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1)[None].float() / 255.0
    return F.interpolate(image, size=(IMAGE_PX, IMAGE_PX), mode="area")


class Lexa:
    """Acts towards the goal image. Its state follows from the episode's images.

    Raises SaccadeError if the weights are missing or damaged, of another architecture, or for other objects.
    """

    def __init__(self, config: Config):
        weights = Weights(config.weights)
        if weights.architecture != "lexa":
            raise SaccadeError(f"weights {weights.folder} are of the architecture {weights.architecture!r}, and this "
                               "agent needs 'lexa': name other weights, or choose the agent that works with these")
        weights.cards_of(config.names)  # among others it would walk on without a word
        actor = weights.fill(Actor(), "lexa")
        assert isinstance(actor, Actor)  # it is what was filled
        self.actor, self.config = actor, config

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode with a new goal. Nothing is published."""
        self.episode = episode
        self.state = self.actor.model.initial(1)
        self.action = torch.zeros(1, ACTIONS)
        self.goal: Tensor | None = None  # its place in the map of distances [1, 32]
        return ()

    @torch.inference_mode()
    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields a plan and an action, from the images so far. Without a goal image the camera stands still.

        The map of distances is wrong by some centimetres. So the camera does not rest where it has arrived: it looks
        around there by chance, and goes there again.
        """
        frame: Frame = inputs["frame"]
        goal: Goal = inputs["goal"]
        if goal.rgb is None:
            return step_from(frame, (np.zeros(3), np.zeros(3)))
        if self.goal is None:
            self.goal = self.actor.aim(self.actor.encoder(small(goal.rgb)))
        self.state = self.actor.fold(self.state, self.action, small(frame.rgb), likeliest)
        self.action = self._action(frame.step)
        move = self.action[0].double().numpy() * SCALE
        return step_from(frame, (move[:3], move[3:]))

    def _action(self, step: int) -> Tensor:
        chance = generator(self.config.seed, self.config.bus.world, self.episode, step, "planner")
        if step % (GOING + AROUND) >= GOING:
            return torch.from_numpy(chance.uniform(-1, 1, (1, ACTIONS)).astype(np.float32))
        assert self.goal is not None
        mean, std = self.actor.towards(self.state, self.goal)
        return torch.tanh(mean + std * torch.from_numpy(chance.normal(size=(1, ACTIONS)).astype(np.float32)))


def build(config: Config) -> Lexa:
    """Creates the core from a run's configuration. Raises SaccadeError if there are no weights of LEXA."""
    return Lexa(config)
