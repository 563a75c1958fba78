"""The planner of the paper's PoseCNN + Infogain: it follows the target's pose, and where the target is not seen it
looks for it with our particle filter and the expected information gain about positions."""

from __future__ import annotations

from collections.abc import Iterable

from saccade.services.planner.core import Planner
from saccade.services.planner.follow import Follower
from saccade.shared.bus.topics import ACTION, BELIEF, GOAL, GOAL_PERCEPT, PERCEPT, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs, Service

SERVICE = Service("planner", inputs=(BELIEF, PERCEPT, GOAL_PERCEPT, GOAL), trigger=BELIEF, outputs=(PLAN, ACTION))


class Seeker:
    """A `Follower` while the target is seen, otherwise a `Planner`, which searches and approaches."""

    def __init__(self, config: Config):
        self.follower, self.planner = Follower(config), Planner(config, config.names)

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode with a new goal. Nothing is published."""
        return (*self.follower.begin(run, episode), *self.planner.begin(run, episode))

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields a plan and an action, computed from the percepts and the beliefs of one step."""
        goal = self.follower.goal(inputs["goal_percept"])
        percept = inputs["percept"][goal.object]
        if self.follower.sees(percept, goal):
            return self.follower.follow(percept, goal, self.planner.obstacles(inputs["belief"]))
        return self.planner.step(inputs)


def build(config: Config) -> Seeker:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights do not serve its objects."""
    return Seeker(config)
