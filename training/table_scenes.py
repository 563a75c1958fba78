"""Draws the scenes that training images show: a camera in the workspace, and objects that stand on the table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.world.geometry import direction, look_at, rotation_towards

GOAL_LIKE = 0.25  # share of images like goal images: one object, with a uniformly drawn elevation
STRANGE_GOAL = 0.25  # share of the images like goal images that show a stranger (see strangers.py)
STRANGE = (0.65, 0.25, 0.10)  # shares of the other images that show no, one and two strangers

Placed = tuple[int, NDArray[np.float64], float]  # number of an object, the centre of its box [3] in m, yaw in rad


class TableScenes:
    """Scenes of `known` objects and, if there is a further size, of strangers. `sizes_m` are the sizes of the boxes."""

    def __init__(self, sizes_m: list[NDArray[np.float64]], known: int):
        self.sizes_m, self.known = sizes_m, known
        self.with_strangers = len(sizes_m) > known

    def draw(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], list[Placed]]:
        """Draws a camera pose [4, 4] and objects [(which, centre [3] in m, yaw in rad)].

        Most scenes are like those that the agent meets, the others like those that goal images show.
        """
        goal_like = rng.random() < GOAL_LIKE
        placed: list[Placed] = []
        for which in self._chosen(goal_like, rng):
            placed.append((which, self._free_place(which, placed, rng), rng.uniform(0, 2 * np.pi)))
        if placed and (goal_like or rng.random() < 0.55):
            which, center, _ = placed[0]
            half = np.linalg.norm(self.sizes_m[which]) / 2
            elevation = rng.uniform(0, np.pi / 2) if goal_like else np.arcsin(rng.random())
            offset = direction(rng.uniform(0, 2 * np.pi), elevation)
            position = center + rng.uniform(half + 0.05, 0.5 if goal_like else 0.8) * offset
            target = center + rng.normal(0, 0.0 if goal_like and rng.random() < 0.7 else 0.06, 3)
        else:
            position = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(0.1, 0.6)])
            target = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.0, 0.15)])
        rotation = rotation_towards(target - position)
        position = np.clip(position, [-0.5, -0.5, 0.1], [0.5, 0.5, 0.6])
        for which, center, _ in placed:
            radius = np.linalg.norm(self.sizes_m[which]) / 2 + 0.05
            away = position - center
            if np.linalg.norm(away) < radius:
                position = center + away * radius / max(np.linalg.norm(away), 1e-6)
        camera = look_at(position, target)
        if goal_like:
            camera[:3, :3] = rotation
        return camera, placed

    def _chosen(self, goal_like: bool, rng: np.random.Generator) -> list[int]:
        """Draws which objects stand on the table: known ones, each at most once, and up to two strangers, shuffled.

        An image like a goal image has one object.
        """
        if goal_like:
            strange = self.with_strangers and rng.random() < STRANGE_GOAL
            return [self.known if strange else int(rng.integers(self.known))]
        number = int(rng.integers(0 if rng.random() < 0.2 else 1, min(5, self.known) + 1))
        chosen = [int(which) for which in rng.permutation(self.known)[:number]]
        if self.with_strangers:
            chosen += [self.known] * int(rng.choice(3, p=STRANGE))
        return [chosen[n] for n in rng.permutation(len(chosen))]

    def _free_place(self, which: int, placed: list[Placed], rng: np.random.Generator) -> NDArray[np.float64]:
        """Draws a centre [3] (m) at which an object does not overlap the others, if 20 attempts are enough."""
        size = self.sizes_m[which]
        radius = np.hypot(size[0], size[1]) / 2
        for _ in range(20):
            xy = rng.uniform(-0.25, 0.25, 2)
            if all(np.linalg.norm(xy - other[1][:2]) > radius + np.hypot(*self.sizes_m[other[0]][:2]) / 2
                   for other in placed):
                break
        return np.array([*xy, size[2] / 2])
