"""The oracle: an agent that is told the goal's pose. It shows that a scene can be solved, and how well at best."""

from __future__ import annotations

from saccade.services.planner.motion import STEP_M, step_towards
from saccade.shared.bus.messages import Action, Truth
from saccade.shared.bus.topics import ACTION, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.task import Spheres, apply_action, clip, success

SERVICE = Service("oracle", inputs=(TRUTH,), trigger=TRUTH, outputs=(ACTION,))


class Oracle:
    """Moves straight to the goal's pose, around the objects; has no state."""

    def __init__(self, step_m: float = STEP_M):
        self.step_m = step_m

    def begin(self, run: str, episode: int) -> list[Output]:
        """Nothing to forget."""
        return []

    def step(self, inputs: Inputs) -> list[Output]:
        """The next action; none once the episode is done."""
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
    """The oracle of a configuration: it takes the planner's steps."""
    return Oracle(config.planner.step_m)
