"""The training of LEXA: it lives in the room, learns its world, and learns to explore and to achieve in imagination."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from saccade.services.planner.lexa import EMBEDDED, State, likeliest
from saccade.training.lexa.behaviour import achiever_loss, explorer_loss
from saccade.training.lexa.replay import Replay
from saccade.training.lexa.room import Living, Room
from saccade.training.lexa.world_model import (
    Learner,
    distance_loss,
    ensemble_loss,
    model_loss,
    observe,
)
from saccade.training.pictures import draw_rows
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import generator_of, on_device

EPISODE, SEQUENCE = 50, 25  # steps of an episode; images of a piece that is learnt from
FIRST = 8  # episodes before the first step of learning
STARTS = 12  # of the states of each piece, from which each policy imagines


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
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            encodings = learner.actor.encoder(batch.images.flatten(0, 1)).unflatten(0, batch.images.shape[:2])
        encodings = encodings.float()
        states, posterior, prior = observe(learner.actor.model, encodings, batch.actions, generator)
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            model, parts = model_loss(learner, batch, encodings, states, posterior, prior)
            spread = ensemble_loss(learner, states, batch.actions, encodings)
            distance = distance_loss(learner, encodings, generator)
            start, goals = self._starts(states, encodings, generator)
            exploring, told = explorer_loss(learner, start, generator)
            achieving, told_too = achiever_loss(learner, start, goals, generator)
        loss = model + spread + distance + exploring + achieving
        parts = {**parts, "time": distance, **told, **told_too}
        return loss, {name: float(value.detach()) for name, value in parts.items()}

    def _starts(self, states: State, encodings: Tensor, generator: torch.Generator) -> tuple[State, Tensor]:
        """States to imagine from, and as many goals: images from anywhere in the same pieces of episodes."""
        everywhere = states.deterministic.shape[0] * states.deterministic.shape[1]
        count = STARTS * states.deterministic.shape[0]
        chosen, wanted = (torch.randint(everywhere, (count,), generator=generator, device=self.device)
                          for _ in range(2))
        start = State(*(part.detach().flatten(0, 1)[chosen] for part in states))
        return start, encodings.detach().view(-1, EMBEDDED)[wanted]

    def _live(self, number: int) -> None:
        """Lives through one episode: the explorer's, or the achiever's towards something that was seen."""
        rng = np.random.default_rng([self.config.seed, 2 ** 32 + number])
        generator = generator_of(self.config, self.part, self.device, 2 ** 32 + number)
        actor = self.module.actor
        if number < FIRST:
            episode = self.room.live(lambda _image: rng.uniform(-1, 1, 6))
        elif number % 2:
            episode = self.room.live(Living(actor, self.module.explorer, None, generator))
        else:
            episode = self.room.live(Living(actor, actor.achiever, self.replay.goal(rng), generator))
        self.replay.add(episode)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    def evaluate(self) -> dict[str, float]:
        """How many steps it has lived through."""
        return {"environment_steps": float(self.replay.steps)}

    @torch.no_grad()
    def draw(self, path: Path) -> None:
        """Draws rows: images of an episode | what the model makes of them, seen one by one | what it imagines from the
        middle on."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        generator = generator_of(self.config, self.part, self.device, 2 ** 31)
        batch, learner = self.replay.sequences(1, SEQUENCE, rng, self.device), self.module
        encodings = learner.actor.encoder(batch.images[0])[None]
        states, _, _ = observe(learner.actor.model, encodings, batch.actions, generator)
        state, imagined = State(states.deterministic[:, 12], states.sample[:, 12]), []
        for n in range(13, SEQUENCE):
            kept, prior = learner.actor.model(state, batch.actions[:, n])
            state = State(kept, likeliest(prior))
            imagined.append(learner.decoder(state.feature)[0])
        seen = learner.decoder(states.feature[0])
        draw_rows(path, [batch.images[0], seen, torch.cat([seen[:13], torch.stack(imagined)])])

    def _episodes_at(self, step: int) -> int:
        """How many episodes have been lived through before a step of learning is done."""
        return FIRST + step // self.config.live_every if step else 0
