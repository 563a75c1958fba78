"""A planner of one's own: it looks at the object whose place is least certain, from where that is seen well.

PYTHONPATH=examples saccade run --explore --set services.planner=greedy_planner
"""

from typing import Any

import numpy as np

from saccade.services.planner.motion import step_towards
from saccade.shared.bus.messages import Action, Belief, Plan
from saccade.shared.bus.topics import ACTION, BELIEF, PLAN, Output
from saccade.shared.loop.service import Service
from saccade.shared.world.geometry import look_at, unit
from saccade.shared.world.task import Spheres

SERVICE = Service("planner", inputs=(BELIEF,), trigger=BELIEF, outputs=(PLAN, ACTION))
RANGE_M = 0.45
NOTHING_IN_THE_WAY = Spheres(np.zeros((0, 3)), np.zeros(0))


class GreedyPlanner:
    def __init__(self, config):
        self.step_m = config.planner.step_m

    def begin(self, run, episode):
        return ()  # nothing to forget

    def step(self, inputs):
        beliefs: dict[str, Belief] = inputs["belief"]  # by object
        vague = max(beliefs.values(), key=lambda belief: np.trace(belief.covariance_m2))
        camera = vague.world_from_camera
        viewpoint = look_at(vague.mean_m + RANGE_M * unit(camera[:3, 3] - vague.mean_m), vague.mean_m)
        translation, rotation = step_towards(camera, viewpoint, NOTHING_IN_THE_WAY, self.step_m)
        stamp: dict[str, Any] = {"run": vague.run, "episode": vague.episode, "step": vague.step}
        yield Output(PLAN, Plan(**stamp, target="", mode="search", viewpoint=viewpoint, look_at_m=vague.mean_m,
                                g_position=0.0, g_scale=0.0, g_pose=0.0, g_information=0.0, candidates=1,
                                goal_confidence=0.0, believed_distance_m=-1.0, arrived=False))
        yield Output(ACTION, Action(**stamp, translation_m=translation, rotation_rad=rotation))


def build(config):
    return GreedyPlanner(config)
