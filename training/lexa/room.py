"""The room in which LEXA lives: the scene of the suite `lexa-room`, at 64 x 64 pixels. Its goals are not used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from saccade.services.planner.lexa import ACTIONS, IMAGE_PX, SCALE, Actor, Policy, small
from saccade.services.simulator.gym_env import ActiveSearch
from saccade.services.simulator.scenes import room_scenes, save_scenes
from saccade.shared.render.objects import load_mesh
from saccade.training.lexa.replay import Episode
from saccade.training.lexa.world_model import sampled

FINER = 2  # the room is rendered finer, and averaged


class Room:
    """Episodes of `length` steps in the room of an object set. The scene is kept in a file in `folder`."""

    def __init__(self, objects: str, names: tuple[str, ...], folder: Path, length: int) -> None:
        path = folder / "room.json"
        save_scenes(path, room_scenes({name: load_mesh(objects, name).size_m for name in names})[:1])
        self.environment = ActiveSearch(objects=objects, names=names, scenes=path, max_steps=length,
                                        size_px=FINER * IMAGE_PX)
        self.length = length

    def live(self, act) -> Episode:
        """One episode. `act(image)` gives the action [6] after each image [64, 64, 3]."""
        observation, _ = self.environment.reset(seed=0)
        images = [_halved(observation["image"])]
        actions: list[NDArray[np.float32]] = []
        terminated = False  # the environment stops where its own goal happens to be reached
        while len(actions) < self.length and not terminated:
            action = act(images[-1])
            observation, _, terminated, _, _ = self.environment.step(action * np.array(SCALE))
            images.append(_halved(observation["image"]))
            actions.append(action.astype(np.float32))
        return Episode(np.stack(images), np.stack(actions))


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    side = image.shape[0] // FINER
    return image.reshape(side, FINER, side, FINER, 3).mean((1, 3)).round().astype(np.uint8)


class Living:
    """A policy at work: it folds the images of an episode into a state, as the planner does, and adds noise."""

    def __init__(self, actor: Actor, policy: Policy, goal: NDArray[np.uint8] | None,
                 generator: torch.Generator) -> None:
        self.actor, self.policy, self.generator = actor, policy, generator
        self.device = generator.device
        self.state = actor.model.initial(1, self.device)
        self.action = torch.zeros(1, ACTIONS, device=self.device)
        self.goal = None if goal is None else actor.encoder(small(goal).to(self.device))

    @torch.no_grad()
    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        self.state = self.actor.fold(self.state, self.action, small(image).to(self.device),
                                     lambda posterior: sampled(posterior, self.generator))
        inputs = self.state.feature if self.goal is None else torch.cat([self.state.feature, self.goal], dim=-1)
        mean, std = self.policy(inputs)
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        self.action = torch.tanh(mean + std * noise)
        return self.action[0].double().cpu().numpy()
