"""What the planner asks of the place: where the camera may look from, what it sees from there, and the next step.

Two places answer: that of the paper, and a workspace that the goal message tells.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from saccade.services.planner.goal import Preference
from saccade.services.planner.motion import along, step_towards, turn_towards
from saccade.shared.bus.messages import Belief
from saccade.shared.errors import SaccadeError
from saccade.shared.world.geometry import Array, direction, viewing_grid
from saccade.shared.world.place import Place
from saccade.shared.world.task import LOWER_M, SUCCESS_TRANSLATION_M, UPPER_M, Spheres, clip
from saccade.shared.world.ways import Ways
from saccade.shared.world.workspace import Boxes, Space

NEARER = 0.3  # chosen: nats per metre of the way, so that the nearest of equally informative viewpoints is taken
HIDDEN_COST = 6.0  # chosen: nats that are added to the cost of a viewpoint from which a wall hides what it looks at
SAME_END_M = 0.03  # chosen: a way stays if its end moves by less than this, as it does with each belief
REACHABLE = 64  # chosen: so many of the best viewpoints are tried before all ways through the place are computed
_PARTS = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (-0.3, 0.3)])  # of a size
UNLIKELY_NATS = 8.0  # chosen: by which a direction is less likely from which the goal image cannot be
SEEN = 0.25  # chosen: share of these parts that is seen in a view that may be the goal's


def way_cost(eyes: Array, camera: Array) -> Array:
    """Cost [N] (nats) of the straight ways from a camera [4, 4] to positions [N, 3]."""
    return np.asarray(NEARER * np.linalg.norm(eyes - camera[:3, 3], axis=1))


class Ground(Protocol):
    """What the planner asks. Positions are in metres, in the world."""

    def anywhere(self, rng: Generator, count: int) -> Array:
        """Positions within reach [count, 3], drawn at random."""

    def within(self, eyes: Array) -> Array:
        """Positions [N, 3], brought within reach."""

    def nearest(self, eye: Array) -> Array:
        """The position [3] as near to another as the camera comes."""

    def is_blocked(self, eyes: Array) -> NDArray[np.bool_]:
        """Which of the positions [N, 3] the camera cannot come near to."""

    def hidden_cost(self, eyes: Array, gazes: Array) -> Array:
        """Cost [N] (nats) of positions [N, 3] that cannot be taken, or from which a wall hides the points [N, 3]."""

    def best(self, cost: Array, eyes: Array, camera: Array) -> int:
        """The number of the position with the least cost [N] that a camera [4, 4] can reach."""

    def told(self, target: Belief, preference: Preference, size_m: Array) -> Belief:
        """A belief about the target, which has a size [3], with what the place says of where its goal image was taken
        from."""

    def step(self, camera: Array, heading: Array, step_m: float) -> tuple[Array, Array]:
        """The next action, a translation [3] and a rotation [3], of a camera [4, 4] towards a pose [4, 4]."""


class PaperGround:
    """The paper's rule: a box, and spheres around the objects."""

    def __init__(self, spheres: Spheres) -> None:
        self.spheres = spheres

    def anywhere(self, rng: Generator, count: int) -> Array:
        return rng.uniform(LOWER_M, UPPER_M, (count, 3))

    def within(self, eyes: Array) -> Array:
        return np.clip(eyes, LOWER_M, UPPER_M)

    def nearest(self, eye: Array) -> Array:
        return clip(eye, self.spheres)

    def is_blocked(self, eyes: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(clip(eyes, self.spheres) - eyes, axis=1) > SUCCESS_TRANSLATION_M)

    def hidden_cost(self, eyes: Array, gazes: Array) -> Array:
        return np.zeros(len(eyes))

    def best(self, cost: Array, eyes: Array, camera: Array) -> int:
        return int(np.argmin(cost))

    def told(self, target: Belief, preference: Preference, size_m: Array) -> Belief:
        return target

    def step(self, camera: Array, heading: Array, step_m: float) -> tuple[Array, Array]:
        return step_towards(camera, heading, self.spheres, step_m)


class Room:
    """A workspace with walls, among the objects that the agent believes in. It keeps the camera's way."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self._way: Array | None = None  # corner points [K, 3] that are left, the last one is the end

    def among(self, objects: Boxes) -> Room:
        """The same place with these objects. Returns itself."""
        self.space: Space = self.place.space(objects)
        return self

    def anywhere(self, rng: Generator, count: int) -> Array:
        lower, upper = self.place.reach.bounds_m()
        return self.place.reach.nearest(rng.uniform(lower, upper, (count, 3)))

    def within(self, eyes: Array) -> Array:
        return self.place.reach.nearest(eyes)

    def nearest(self, eye: Array) -> Array:
        try:
            return self.space.nearest(eye)
        except SaccadeError:  # objects that are believed to be everywhere are not
            return self.place.reach.nearest(eye)

    def is_blocked(self, eyes: Array) -> NDArray[np.bool_]:
        gaps = np.linalg.norm(self.place.reach.nearest(eyes) - eyes, axis=1)
        return np.asarray(np.maximum(gaps, -self.space.room_m(eyes)) > SUCCESS_TRANSLATION_M)

    def hidden_cost(self, eyes: Array, gazes: Array) -> Array:
        cost = np.where(self.place.hides(eyes, gazes), HIDDEN_COST, 0.0)
        return np.where(self.space.allows(eyes) | ~self.is_blocked(eyes), cost, np.inf)

    def best(self, cost: Array, eyes: Array, camera: Array) -> int:
        here = self.nearest(camera[:3, 3])
        order = np.argsort(cost, kind="stable")  # the first of equals, as argmin takes it
        first = int(order[0])
        if np.isfinite(cost[first]) and self.space.free(here, self.nearest(eyes[first])):
            return first
        apart = np.linalg.norm(eyes - here, axis=1)
        lengths = Ways(self.space, here).lengths_m(eyes)
        longer = NEARER * np.maximum(lengths - apart, 0.0)
        for k in order[:REACHABLE]:  # the lattice is coarse, and may say that a place in a corner cannot be reached
            if not np.isfinite(lengths[k]) and np.isfinite(cost[k]) and self.space.free(here, self.nearest(eyes[k])):
                longer[k] = 0.0
        total = cost + longer
        return int(np.argmin(total)) if np.isfinite(total).any() else first

    def told(self, target: Belief, preference: Preference, size_m: Array) -> Belief:
        """The goal's camera was where the camera may be, and saw the target."""
        if target.goal_log_posterior is None:
            return target
        elevation, azimuth = viewing_grid()
        away = direction(azimuth, elevation[:, None]).reshape(-1, 3)
        unlikely = self._cannot_be(target.mean_m, preference.range_m * away, size_m)
        posterior = target.goal_log_posterior - UNLIKELY_NATS * unlikely.reshape(target.goal_log_posterior.shape)
        fine = posterior.astype(np.float64)
        fine -= fine.max()
        target = replace(target, goal_log_posterior=(fine - np.log(np.exp(fine).sum())).astype(np.float32))
        if target.goal_rotations is None or target.goal_rotations_log_probability is None:
            return target
        away = -(target.goal_rotations @ preference.ray)
        unlikely = self._cannot_be(target.mean_m, preference.range_m * away, size_m)
        return replace(target, goal_rotations_log_probability=target.goal_rotations_log_probability
                       - UNLIKELY_NATS * unlikely)

    def _cannot_be(self, center: Array, away_m: Array, size_m: Array) -> NDArray[np.bool_]:
        """Whether cameras at `away_m` [N, 3] from a target at `center` [3] cannot be there, or see too little of it."""
        eyes = center + away_m
        hidden = self.place.hides(eyes[:, None], center + _PARTS * size_m).mean(1)
        return np.asarray(self.is_blocked(eyes) | (hidden > 1.0 - SEEN))

    def step(self, camera: Array, heading: Array, step_m: float) -> tuple[Array, Array]:
        here, there = self.nearest(camera[:3, 3]), self.nearest(heading[:3, 3])
        way = self._kept(here, there)
        if way is None:
            way = self._found(here, there)
        while len(way) > 1 and self.space.free(here, way[1]):
            way = way[1:]
        self._way = way
        return along(np.array([here, *way]), step_m) - camera[:3, 3], turn_towards(camera[:3, :3], heading[:3, :3])

    def _kept(self, here: Array, there: Array) -> Array | None:
        """The way as it was, with its end at a position [3]. None if it led elsewhere or is not free any more."""
        if self._way is None or np.linalg.norm(self._way[-1] - there) > SAME_END_M:
            return None
        way = np.array([*self._way[:-1], there])
        return way if all(self.space.free(a, b) for a, b in pairwise([here, *way])) else None

    def _found(self, here: Array, there: Array) -> Array:
        """The corner points [K, 3] of a way to a position [3]. If there is none, the straight line: the camera goes as
        far as it comes, and what is in the way is seen better from there."""
        if not self.space.free(here, there):
            found = Ways(self.space, here).to([there])
            if found is not None:
                return found[0][1:]
        return there[None]
