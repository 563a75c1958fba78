"""The training of LEXA: it lives in the room, learns its world, and learns to explore and to achieve in imagination."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.planner.lexa import State, likeliest
from saccade.training.lexa.behaviour import achiever_loss, explorer_loss
from saccade.training.lexa.replay import Replay
from saccade.training.lexa.room import Achieving, Darting, Exploring, Room
from saccade.training.lexa.world_model import (
    Learner,
    distance_loss,
    distance_of,
    ensemble_loss,
    model_loss,
    observe,
    patched,
)
from saccade.training.pictures import draw_rows
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import generator_of, on_device

EPISODE, SEQUENCE = 100, 16  # steps of an episode; images of a piece that is learnt from
FIRST, BLIND = 60, 160  # episodes before the first step of learning, and those in which chance acts
AIMED, VIEWS = 5, 128  # images of a piece, and of the whole life, that the map of distances learns to find
RARE_OF = 256  # images that were seen, of which the rarest is gone to
STARTS = 12  # of the states of each piece, from which each policy imagines
BEHAVE_FROM, BEHAVE_EVERY = 500, 2  # steps of learning: the policies need fewer than the model, and later
MODEL_WEIGHT, DISTANCE_WEIGHT = 0.01, 50.0  # the gradients of all losses are clipped together
MEASURED, MEASURED_STEPS = 20, 120  # goals and steps at a checkpoint


class LexaTask:
    """Trains LEXA in the room of an object set. Episodes are kept beside the checkpoint, in `folder`."""

    def __init__(self, config: TrainingConfig, part: str, device: torch.device, folder: Path, step: int):
        torch.manual_seed(config.seed)
        self.config, self.part, self.device, self.folder = config, part, device, folder
        self.module = on_device(Learner(), device)
        self.room = Room(config.objects, config.names, folder, EPISODE)
        self.replay = Replay(folder / "episodes", self._episodes_at(step))
        self.lambdas: list[float] = []

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts. Before some steps an episode is lived through."""
        while len(self.replay.episodes) < self._episodes_at(step + 1):
            self._live(len(self.replay.episodes))
        rng = np.random.default_rng([self.config.seed, step])
        generator = generator_of(self.config, self.part, self.device, step)
        batch = self.replay.sequences(self.config.batch_extraction, SEQUENCE, rng, self.device)
        learner = self.module
        with reduced_precision(self.device):
            encodings = learner.actor.encoder(batch.images.flatten(0, 1)).unflatten(0, batch.images.shape[:2])
        encodings = encodings.float()
        states, posterior, prior = observe(learner.actor.model, encodings, batch.actions, generator)
        with reduced_precision(self.device):
            model, parts = model_loss(learner, batch, encodings, states, posterior, prior, generator)
            spread = ensemble_loss(learner, states, batch.actions, encodings)
            chosen = torch.randperm(SEQUENCE, generator=generator, device=self.device)[:AIMED]
            views, sums = self.replay.views(VIEWS, rng, self.device)
            images = torch.cat([batch.images[:, chosen].flatten(0, 1), views])
            aimed = torch.cat([batch.travelled[:, chosen].flatten(0, 1), sums])
            aims = learner.actor.aim(learner.actor.encoder(patched(images, generator))).float()
            time = distance_loss(learner.actor.place(states.feature).float().flatten(0, 1), aims,
                                 batch.travelled.flatten(0, 1), aimed)
            loss = MODEL_WEIGHT * (model + DISTANCE_WEIGHT * time) + spread
            parts = {**parts, "time": time}
            if step >= BEHAVE_FROM and step % BEHAVE_EVERY == 0:
                start, wanted = self._starts(states, aims, generator)
                exploring, told = explorer_loss(learner, State(*(part[::2] for part in start)), generator)
                achieving, told_too = achiever_loss(learner, start, wanted, generator)
                loss = loss + exploring + achieving
                parts = {**parts, **told, **told_too}
        return loss, {name: float(value.detach()) for name, value in parts.items()}

    def _starts(self, states: State, aims: Tensor, generator: torch.Generator) -> tuple[State, Tensor]:
        """States to imagine from, and as many aims: of images from anywhere."""
        pieces, length = states.deterministic.shape[:2]
        count = STARTS * pieces

        def drawn(among: int) -> Tensor:
            return torch.randint(among, (count,), generator=generator, device=self.device)

        chosen, goals = drawn(pieces * length), drawn(len(aims))
        near = AIMED * (chosen // length) + drawn(AIMED)  # every other goal is of the same piece
        goals = torch.where(torch.arange(count, device=self.device) % 4 < 2, near, goals)
        return State(*(part.detach().flatten(0, 1)[chosen] for part in states)), aims.detach()[goals]

    def _live(self, number: int) -> None:
        """Lives through one episode. In the first ones chance acts. Later, in one of four, the explorer acts; in the
        others the achiever goes to something rare that was seen, moves by chance around it, and goes on to the next.
        """
        rng = np.random.default_rng([self.config.seed, 2 ** 32 + number])
        generator = generator_of(self.config, self.part, self.device, 2 ** 32 + number)
        if number < BLIND:
            episode = self.room.live(Darting(rng) if number % 2 else lambda _image: rng.uniform(-1, 1, 6))
        elif number % 4 == 0:
            episode = self.room.live(Exploring(self.module, generator))
        else:
            episode = self.room.live(Achieving(self.module, lambda: self._rare(rng), generator))
        self.replay.add(episode)

    @torch.no_grad()
    def _rare(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """An image [32, 32, 3] that was seen where little was seen: of some, the one farthest from the others."""
        views, _ = self.replay.views(RARE_OF, rng, self.device)
        aims = self.module.actor.aim(self.module.actor.encoder(views))
        apart = distance_of(aims, aims, all_pairs=True)
        rarest = views[int(apart.sort(1).values[:, 1:4].mean(1).argmax())]
        return (rarest.permute(1, 2, 0) * 255).round().byte().cpu().numpy()

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    def evaluate(self) -> dict[str, float]:
        """How many steps it has lived through; how many goals were tried, none of which is of the suite or learnt from,
        and what share of them the achiever reaches; and the median of how near it comes, in tolerances."""
        generator = generator_of(self.config, self.part, self.device, 2 ** 31)
        nearest = [self.room.reach(number, MEASURED_STEPS, lambda goal: Achieving(self.module, lambda: goal, generator))
                   for number in range(MEASURED)]
        return {"environment_steps": float(self.replay.steps), "goals": float(MEASURED),
                "reached": float(np.mean(np.array(nearest) < 1.0)), "nearest": float(np.median(nearest))}

    @torch.no_grad()
    def draw(self, path: Path) -> None:
        """Draws rows: images of an episode | what the model makes of them, seen one by one | what it imagines from the
        middle on."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        generator = generator_of(self.config, self.part, self.device, 2 ** 31)
        batch, learner = self.replay.sequences(1, SEQUENCE, rng, self.device), self.module
        encodings = learner.actor.encoder(batch.images[0])[None]
        states, _, _ = observe(learner.actor.model, encodings, batch.actions, generator)
        state, imagined = State(states.deterministic[:, 7], states.sample[:, 7]), []
        for n in range(8, SEQUENCE):
            kept, prior = learner.actor.model(state, batch.actions[:, n])
            state = State(kept, likeliest(prior))
            imagined.append(learner.decoder(state.feature)[0])
        seen = learner.decoder(states.feature[0])
        draw_rows(path, [batch.images[0], seen, torch.cat([seen[:8], torch.stack(imagined)])])

    def _episodes_at(self, step: int) -> int:
        """How many episodes have been lived through before a step of learning is done."""
        return FIRST + step // self.config.live_every if step else 0
