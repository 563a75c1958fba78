"""Planners that know nothing, to compare with: one stands still, the other walks at random. They are not services.

`still` and `random_walk` make services of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from saccade.shared.bus.messages import Action, Frame, Plan
from saccade.shared.bus.topics import ACTION, FRAME, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.geometry import Array

SERVICE = Service("planner", inputs=(FRAME,), trigger=FRAME, outputs=(PLAN, ACTION))
TURN_RAD = 0.1  # the standard deviation of a random turn about each axis


class Blind:
    """Moves without looking: not at all, or by steps of the length `step_m` in random directions."""

    def __init__(self, config: Config, *, walks: bool):
        self.config, self.walks = config, walks

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode. Nothing is published."""
        self.episode = episode
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields a plan and an action."""
        frame: Frame = inputs["frame"]
        move, turn = self._move(frame.step) if self.walks else (np.zeros(3), np.zeros(3))
        return outputs(frame, move, turn)

    def _move(self, step: int) -> tuple[Array, Array]:
        rng = generator(self.config.seed, self.config.bus.world, self.episode, step, "random walk")
        direction = rng.normal(size=3)
        return self.config.planner.step_m * direction / np.linalg.norm(direction), rng.normal(0, TURN_RAD, 3)


def outputs(frame: Frame, translation_m: Array, rotation_rad: Array) -> Iterable[Output]:
    """The action, and a plan that says nothing but where the camera is to go."""
    viewpoint = np.array(frame.world_from_camera)
    viewpoint[:3, 3] += translation_m
    stamp: dict[str, Any] = {"run": frame.run, "episode": frame.episode, "step": frame.step}
    yield Output(PLAN, Plan(**stamp, target="", mode="search", viewpoint=viewpoint,
                            look_at_m=viewpoint[:3, 3] - 0.4 * viewpoint[:3, 2], g_position=0.0, g_scale=0.0,
                            g_pose=0.0, g_information=0.0, candidates=1, goal_confidence=0.0,
                            believed_distance_m=-1.0, arrived=False))
    yield Output(ACTION, Action(**stamp, translation_m=translation_m, rotation_rad=rotation_rad))
