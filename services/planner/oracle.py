"""The oracle: an agent that knows the goal's pose. It shows whether a scene can be solved, and how well at best."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from saccade.services.planner.motion import STEP_M, along, step_towards, turn_towards
from saccade.shared.bus.messages import Action, Goal, Truth
from saccade.shared.bus.topics import ACTION, GOAL, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.geometry import Array, pose
from saccade.shared.world.place import place_of
from saccade.shared.world.task import SUCCESS_TRANSLATION_M, Spheres, apply_action, clip, success
from saccade.shared.world.ways import find_way
from saccade.shared.world.workspace import Boxes, Space

SERVICE = Service("oracle", inputs=(TRUTH, GOAL), trigger=TRUTH, outputs=(ACTION,))


class Oracle:
    """Moves to the goal's pose on the shortest path around the objects.

    In a workspace it goes around all that is in the way. It keeps a way as long as that is free, and stays where it is
    if there is none, or if there is no target: the episode then ends without success. In other scenes it has no state.
    """

    def __init__(self, step_m: float = STEP_M):
        self.step_m = step_m
        self._way: Array | None = None
        self._instance = 0  # of the target to whose view the way leads

    def begin(self, run: str, episode: int) -> list[Output]:
        """Forgets the way of the last episode. Nothing is published."""
        self._way = None
        return []

    def step(self, inputs: Inputs) -> list[Output]:
        """Returns the next action, or nothing when the episode is over."""
        truth: Truth = inputs["truth"]
        if truth.done:
            return []
        space = known_space(inputs["goal"], truth)
        if space is None:
            spheres = Spheres(truth.centers_m, truth.keep_out_m)
            move = step_towards(truth.world_from_camera, truth.goal_world_from_camera, spheres, self.step_m)
            camera = apply_action(truth.world_from_camera, *move)
            camera[:3, 3] = clip(camera[:3, 3], spheres)
        else:
            move = self._move(truth, space)
            camera = apply_action(truth.world_from_camera, *move)
        arrived = truth.target in truth.names and success(camera, truth.goal_world_from_camera)
        action = Action(run=truth.run, episode=truth.episode, step=truth.step, translation_m=move[0],
                        rotation_rad=move[1], arrived=arrived)
        return [Output(ACTION, action)]

    def _move(self, truth: Truth, space: Space) -> tuple[Array, Array]:
        """The next translation [3] in metres and rotation [3] in radians in a workspace."""
        if truth.target not in truth.names:
            return np.zeros(3), np.zeros(3)
        here = space.nearest(truth.world_from_camera[:3, 3])
        goals = self._goals(truth, space)
        at = goals.get(self._instance)
        if self._way is None or at is None or not self._is_free(space, here, at[0]):
            found = find_way(space, here, [eye for eye, _ in goals.values()]) if goals else None
            self._way = None if found is None else found[0][1:]
            if found is not None:
                self._instance = list(goals)[found[1]]
        if self._way is None:
            return np.zeros(3), np.zeros(3)
        while len(self._way) > 1 and space.free(here, self._way[1]):
            self._way = self._way[1:]
        turn = turn_towards(truth.world_from_camera[:3, :3], goals[self._instance][1])
        return along(np.array([here, *self._way]), self.step_m) - truth.world_from_camera[:3, 3], turn

    def _goals(self, truth: Truth, space: Space) -> dict[int, tuple[Array, Array]]:
        """For each of the target's kind that has a view like the goal's within reach: the position [3] and the rotation
        [3, 3] there."""
        turned, numbers = truth.world_from_objects(), truth.instances
        assert numbers is not None  # they are told in a workspace
        poses = {int(numbers[k]): pose(turned[k], truth.centers_m[k]) for k, name in enumerate(truth.names)
                 if name == truth.target}
        seen_from = np.linalg.inv(poses[truth.target_instance]) @ truth.goal_world_from_camera
        views = {number: world_from_object @ seen_from for number, world_from_object in poses.items()}
        near = {number: (space.nearest(view[:3, 3]), view[:3, :3]) for number, view in views.items()}
        return {number: goal for number, goal in near.items()
                if np.linalg.norm(goal[0] - views[number][:3, 3]) < SUCCESS_TRANSLATION_M}

    def _is_free(self, space: Space, here: Array, there: Array) -> bool:
        """Whether the rest of the way still leads to the goal's position [3], and nothing stands in it."""
        assert self._way is not None  # asked only with a way
        return np.array_equal(self._way[-1], there) and all(
            space.free(a, b) for a, b in pairwise([here, *self._way]))


def known_space(goal: Goal, truth: Truth) -> Space | None:
    """What the camera may do among the true objects. None if the rule of the paper holds."""
    place = place_of(goal)
    if truth.sizes_m is None or place is None:
        return None
    return place.space(Boxes(np.asarray(truth.centers_m), np.asarray(truth.world_from_objects()),
                             np.asarray(truth.sizes_m)))


def build(config: Config) -> Oracle:
    """Creates the oracle from a configuration. Its steps are as long as the planner's (`planner.step_m`)."""
    return Oracle(config.planner.step_m)
