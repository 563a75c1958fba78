"""The oracle: an agent that knows the goal's pose. It shows whether a scene can be solved, and how well at best."""

from __future__ import annotations

from saccade.services.planner.motion import STEP_M, step_towards
from saccade.shared.bus.messages import Action, Truth
from saccade.shared.bus.topics import ACTION, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.task import Spheres, apply_action, clip, success

SERVICE = Service("oracle", inputs=(TRUTH,), trigger=TRUTH, outputs=(ACTION,))


class Oracle:
    """Moves to the goal's pose on the shortest path around the objects. It has no state."""

    def __init__(self, step_m: float = STEP_M):
        self.step_m = step_m

    def begin(self, run: str, episode: int) -> list[Output]:
        """Does nothing, because the oracle has no state. Nothing is published."""
        return []

    def step(self, inputs: Inputs) -> list[Output]:
        """Returns the next action, or nothing when the episode is over."""
        truth: Truth = inputs["truth"]
        if truth.done:
            return []
        spheres = Spheres(truth.centers_m, truth.keep_out_m)
        move = step_towards(truth.world_from_camera, truth.goal_world_from_camera, spheres, self.step_m)
        camera = apply_action(truth.world_from_camera, *move)
        camera[:3, 3] = clip(camera[:3, 3], spheres)
        arrived = success(camera, truth.goal_world_from_camera)
        action = Action(run=truth.run, episode=truth.episode, step=truth.step, translation_m=move[0],
                        rotation_rad=move[1], arrived=arrived)
        return [Output(ACTION, action)]


def build(config: Config) -> Oracle:
    """Creates the oracle from a configuration. Its steps are as long as the planner's (`planner.step_m`)."""
    return Oracle(config.planner.step_m)
