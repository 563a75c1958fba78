"""Planners that know nothing, to compare with: one stands still, the other walks at random. They are not services.

`still` and `random_walk` make services of them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from saccade.services.planner.outputs import Move, step_from
from saccade.shared.bus.messages import Frame
from saccade.shared.bus.topics import ACTION, FRAME, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service

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
        return step_from(frame, self._move(frame.step) if self.walks else (np.zeros(3), np.zeros(3)))

    def _move(self, step: int) -> Move:
        rng = generator(self.config.seed, self.config.bus.world, self.episode, step, "random walk")
        direction = rng.normal(size=3)
        return self.config.planner.step_m * direction / np.linalg.norm(direction), rng.normal(0, TURN_RAD, 3)
