"""The planner of the paper's PoseCNN: it follows the transform between the target's pose now and in the goal image.

The percepts must carry poses. Every step moves the camera by at most 5 cm towards the goal's view, and turns it by the
same share of what is left to turn. Where the target is not seen, the camera stops. `seek` looks for it instead.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.services.planner.motion import step_towards
from saccade.services.planner.outputs import outputs
from saccade.shared.bus.messages import Percept
from saccade.shared.bus.topics import ACTION, GOAL_PERCEPT, PERCEPT, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.geometry import Array, pose, rotation_angle
from saccade.shared.world.task import Spheres

SERVICE = Service("planner", inputs=(PERCEPT, GOAL_PERCEPT), trigger=PERCEPT, outputs=(PLAN, ACTION))

ARRIVED_M, ARRIVED_RAD = 0.02, 0.1  # the agent says that it has arrived if the transform that is left is below these
NO_SPHERES = Spheres(np.zeros((0, 3)), np.zeros(0))  # it knows nothing of what is in the way


class Follower:
    """Follows the relative pose. Its only state is which object the goal image shows."""

    def __init__(self, config: Config):
        self.step_m, self.present_above = config.planner.step_m, config.belief.present_above
        self.explores = config.scene.explore

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode with a new goal. Nothing is published."""
        self.target: str | None = None
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields a plan and an action, computed from the percepts of one image."""
        percepts: dict[str, Percept] = inputs["percept"]
        goal = self.goal(inputs["goal_percept"])
        seen = percepts[goal.object]
        yield from self.follow(seen, goal) if self.sees(seen, goal) else self._stop(seen, goal)

    def goal(self, goals: dict[str, Percept]) -> Percept:
        """The goal's percept of the target, which is the object with the highest presence."""
        if self.target is None:
            self.target = max(sorted(goals), key=lambda name: goals[name].presence)
        return goals[self.target]

    def sees(self, percept: Percept, goal: Percept) -> bool:
        """Whether there is a transform to follow: the target is seen, and there is a goal image.

        Raises SaccadeError if the percepts carry no poses.
        """
        if percept.camera_from_object is None or goal.camera_from_object is None:
            raise SaccadeError("this planner follows poses, and the percepts carry none: choose an agent whose "
                               "perception estimates poses, such as posecnn")
        return not self.explores and goal.presence > 0.0 and percept.presence > self.present_above

    def follow(self, percept: Percept, goal: Percept, spheres: Spheres = NO_SPHERES) -> Iterable[Output]:
        """Yields the plan to go where the goal image was taken, and the next step on this way, around the spheres."""
        camera = percept.world_from_camera
        viewpoint = goal_view(percept, goal)
        distance = float(np.linalg.norm(viewpoint[:3, 3] - camera[:3, 3]))
        turn = float(rotation_angle(viewpoint[:3, :3], camera[:3, :3]))
        move = step_towards(camera, on_the_way(camera, viewpoint, self.step_m / max(distance, self.step_m)), spheres,
                            self.step_m)
        arrived = distance < ARRIVED_M and turn < ARRIVED_RAD
        center = (camera @ np.asarray(percept.camera_from_object))[:3, 3]
        return outputs(percept, viewpoint, move, look_at_m=center, target=goal.object, goal_confidence=goal.presence,
                       believed_distance_m=distance, arrived=arrived)

    def _stop(self, percept: Percept, goal: Percept) -> Iterable[Output]:
        return outputs(percept, np.array(percept.world_from_camera), (np.zeros(3), np.zeros(3)), target=goal.object,
                       goal_confidence=goal.presence)


def goal_view(percept: Percept, goal: Percept) -> Array:
    """The pose world_from_camera [4, 4] from which the goal image was taken, by the target's poses in both images."""
    there = np.linalg.inv(np.asarray(goal.camera_from_object))
    return np.asarray(percept.world_from_camera @ np.asarray(percept.camera_from_object) @ there)


def on_the_way(camera: Array, viewpoint: Array, share: float) -> Array:
    """The viewpoint [4, 4] with the attitude that belongs to this share of the way from a camera [4, 4] to it.

    Whoever turns at once as at the goal loses sight of the target on the way.
    """
    turn = Rotation.from_matrix(viewpoint[:3, :3] @ camera[:3, :3].T).as_rotvec()
    return pose(Rotation.from_rotvec(share * turn).as_matrix() @ camera[:3, :3], viewpoint[:3, 3])


def build(config: Config) -> Follower:
    """Creates the core from a run's configuration."""
    return Follower(config)
