"""The room in which LEXA lives: the scene of the suite `lexa-room`, at 32 x 32 pixels, without the suite's goals."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.planner.lexa import ACTIONS, AROUND, GOING, IMAGE_PX, SCALE, Actor, small
from saccade.services.simulator.core import Simulator
from saccade.services.simulator.scenes import draw_goal, room_scenes, save_scenes
from saccade.shared.bus.messages import Action, Frame, Goal
from saccade.shared.bus.topics import Output
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, rotation_angle
from saccade.shared.world.task import SUCCESS_ROTATION_RAD, SUCCESS_TRANSLATION_M
from saccade.training.lexa.replay import Episode
from saccade.training.lexa.world_model import Learner, sampled

FINER = 2  # the room is rendered finer, and averaged
DARTS = 8.0  # full steps from the start, in each direction, up to which chance darts
GOALS_SEED = 16_449  # of the goals on which the training is measured: none is of the suite, and none is learnt from

Act = Callable[[NDArray[np.uint8]], NDArray[np.float64]]


class Room:
    """Episodes of `length` steps in the room of an object set. The scene is kept in a file in `folder`."""

    def __init__(self, objects: str, names: tuple[str, ...], folder: Path, length: int) -> None:
        meshes = {name: load_mesh(objects, name) for name in names}
        self.sizes_m = {name: mesh.size_m for name, mesh in meshes.items()}
        self.scene = room_scenes(self.sizes_m)[0]
        save_scenes(folder / "room.json", [self.scene])
        size_px = FINER * IMAGE_PX
        self.world = World(tuple(meshes.values()), size_px=size_px,
                           intrinsics_px=np.array(INTRINSICS_PX) * size_px / IMAGE_SIZE_PX)
        self.length = length

    def live(self, act: Act) -> Episode:
        """One episode, in which no goal is given. `act(image)` gives the action [6] after each image [32, 32, 3]."""
        simulator = Simulator(self.world, [self.scene], max_steps=self.length + 1, explore=True)
        images = [_image(simulator.begin("life", 0))]
        actions: list[NDArray[np.float32]] = []
        for _ in range(self.length):
            action = act(images[-1])
            images.append(_image(_moved(simulator, action)))
            actions.append(action.astype(np.float32))
        return Episode(np.stack(images), np.stack(actions))

    def goal(self, number: int) -> tuple[str, NDArray[np.float64]]:
        """A goal of the measure: its target and world_from_camera [4, 4], drawn as the suite's, but from another
        seed."""
        present = self.scene.on_table
        index = number % len(present)
        return present[index].name, draw_goal(
            np.random.default_rng([GOALS_SEED, number]), [placed.center_m for placed in present],
            [self.sizes_m[placed.name] for placed in present], index)

    def reach(self, number: int, steps: int, act_for: Callable[[NDArray[np.uint8]], Act]) -> float:
        """How near one comes to a goal of the measure, in tolerances: below 1 it is reached. `act_for(goal)` gives what
        acts, for the goal's image [H, W, 3]."""
        target, goal = self.goal(number)
        scene = replace(self.scene, target=target, goal_world_from_camera=goal)
        simulator = Simulator(self.world, [scene], max_steps=steps)
        begun = simulator.begin("measure", 0)
        shown, = (output.message.rgb for output in begun if isinstance(output.message, Goal))
        assert shown is not None  # who measures does not explore
        act, image, nearest = act_for(shown), _image(begun), np.inf
        while True:
            outputs = _moved(simulator, act(image))
            camera = simulator.state.camera
            nearest = min(nearest, max(
                float(np.linalg.norm(camera[:3, 3] - goal[:3, 3])) / SUCCESS_TRANSLATION_M,
                float(rotation_angle(camera[:3, :3], goal[:3, :3])) / SUCCESS_ROTATION_RAD))
            if simulator.state.done:
                return nearest
            image = _image(outputs)


def _moved(simulator: Simulator, action: NDArray[np.float64]) -> Iterable[Output]:
    move = action * np.array(SCALE)
    return simulator.step({"action": Action(run="life", episode=0, step=simulator.state.step, translation_m=move[:3],
                                            rotation_rad=move[3:])})


def _image(outputs: Iterable[Output]) -> NDArray[np.uint8]:
    """The frame's image [32, 32, 3]."""
    image, = (output.message.rgb for output in outputs if isinstance(output.message, Frame))
    return image.reshape(IMAGE_PX, FINER, IMAGE_PX, FINER, 3).mean((1, 3)).round().astype(np.uint8)


class Darting:
    """Chance that keeps on: it goes to one sum of actions after the other, each as far from the start as chance says.
    So the model comes to know long straight ways."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.sum, self.to = rng, np.zeros(ACTIONS), np.zeros(ACTIONS)

    def __call__(self, _image: NDArray[np.uint8]) -> NDArray[np.float64]:
        if np.abs(self.to - self.sum).max() < 1.0:
            self.to = self.rng.uniform(-DARTS, DARTS, ACTIONS)
        way = self.to - self.sum
        action = np.clip(way / max(1.0, np.abs(way).max()) + self.rng.normal(0, 0.3, ACTIONS), -1.0, 1.0)
        self.sum = self.sum + action
        return action


class Living:
    """A policy at work: it folds the images of an episode into a state, as the planner does, and adds noise."""

    def __init__(self, learner: Learner, generator: torch.Generator) -> None:
        self.learner, self.generator, self.device = learner, generator, generator.device
        self.actor: Actor = learner.actor
        self.state = self.actor.model.initial(1, self.device)
        self.action = torch.zeros(1, ACTIONS, device=self.device)

    def act(self) -> Tensor:
        """The action [1, 6] in the state."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        self.state = self.actor.fold(self.state, self.action, small(image).to(self.device),
                                     lambda posterior: sampled(posterior, self.generator))
        self.action = self.act()
        return self.action[0].double().cpu().numpy()

    def drawn(self, mean: Tensor, std: Tensor) -> Tensor:
        """A sample of what a policy says."""
        return torch.tanh(mean + std * torch.randn(mean.shape, generator=self.generator, device=self.device))

    @torch.no_grad()
    def aim_of(self, goal: NDArray[np.uint8]) -> Tensor:
        """Where a goal image [H, W, 3] is in the map of distances [1, 32]."""
        return self.actor.aim(self.actor.encoder(small(goal).to(self.device)))


class Exploring(Living):
    """The explorer."""

    def act(self) -> Tensor:
        return self.drawn(*self.learner.explorer(self.state.feature))


class Achieving(Living):
    """The achiever on the way to a goal image [H, W, 3], and chance around it, as the planner acts. After each round it
    goes on to what `next_goal()` gives, which may be the same."""

    def __init__(self, learner: Learner, next_goal: Callable[[], NDArray[np.uint8]],
                 generator: torch.Generator) -> None:
        super().__init__(learner, generator)
        self.next_goal, self.step = next_goal, 0

    def act(self) -> Tensor:
        there, self.step = self.step % (GOING + AROUND), self.step + 1
        if there == 0:
            self.aim = self.aim_of(self.next_goal())
        if there < GOING:
            return self.drawn(*self.actor.towards(self.state, self.aim))
        return 2 * torch.rand(1, ACTIONS, generator=self.generator, device=self.device) - 1
