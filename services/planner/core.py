"""Chooses viewpoints by minimising expected free energy and moves the camera there in short steps (paper, section 3.3).

Candidates are drawn by importance: mostly views of where the target is believed to be, from where the goal would look
as it does. The viewpoint is chosen anew every few steps or on arrival; on arrival at the believed goal the agent says
so, and goes on to the next likely view should it still be asked to act.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from services.planner.free_energy import Terms, expected_free_energy
from services.planner.goal import aim, infer_preference
from services.planner.motion import step_towards
from shared.config import Config
from shared.errors import SaccadeError
from shared.geometry import Array, direction, look_at, rotation_angle, unit, viewing_grid
from shared.messages import Action, Belief, Plan
from shared.seeding import generator
from shared.service import Inputs, Output, Service
from shared.task import LOWER_M, UPPER_M, Spheres, clip, spheres_around
from shared.topics import ACTION, BELIEF, GOAL_PERCEPT, PLAN
from shared.weights import Weights

SERVICE = Service("planner", inputs=(BELIEF, GOAL_PERCEPT), trigger=BELIEF, outputs=(PLAN, ACTION))

FOUND_M = 0.06  # deviation of the position below which the target counts as found
KNOWN_M = 0.10  # objects less certain than this are no obstacle yet
ARRIVED_M, ARRIVED_RAD = 0.01, 0.05
TURN_M = 0.10  # from here on the camera turns as planned; before, it keeps looking at what it is about
VISITED_RAD = 0.45  # around a view that turned out not to be the goal
VISITED_COST = 6.0  # nats


class Planner:
    """Beliefs in, plans and actions out."""

    def __init__(self, config: Config, names: tuple[str, ...]):
        self.config, self.names = config, names
        self.sizes_m = {card.name: card.size_m for card in Weights(config.weights).cards_of(names)}

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """A new goal."""
        self.episode, self.preference, self.goal_known = episode, None, False
        self.viewpoint: Array | None = None
        self.plan: Plan | None = None
        self.age = 0
        self.visited: list[Array] = []  # directions from the target
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """A plan and an action from the beliefs of one step."""
        beliefs: dict[str, Belief] = inputs["belief"]
        if not self.goal_known:
            self.goal_known = True
            if not self.config.scene.explore:
                self.preference = infer_preference(inputs["goal_percept"], self.config.planner.range_std_m)
        any_belief = beliefs[self.names[0]]
        camera = any_belief.world_from_camera
        spheres = self._obstacles(beliefs)
        arrived = self.viewpoint is not None and _at(camera, self.viewpoint)
        declared = False
        if arrived and self.plan is not None and self.plan.mode == "goal":
            declared = True
            self.visited.append(unit(camera[:3, 3] - beliefs[self.plan.target].mean_m))
        self.age += 1
        if self.plan is None or arrived or self.age >= self.config.planner.replan_every:
            self._choose(any_belief, beliefs, camera, spheres)
        elif self.plan.mode == "goal":
            self.viewpoint = self._goal_viewpoint(beliefs[self.plan.target], spheres)
        plan = self._publish(any_belief, camera, beliefs, declared)
        heading = self._heading(camera, beliefs)
        translation, rotation = step_towards(camera, heading, spheres, self.config.planner.step_m)
        yield Output(PLAN, plan)
        yield Output(ACTION, Action(run=plan.run, episode=plan.episode, step=plan.step, translation_m=translation,
                                    rotation_rad=rotation, arrived=declared))

    def _heading(self, camera: Array, beliefs: dict[str, Belief]) -> Array:
        """Where to go and how to look meanwhile [4, 4]: at the point of interest on the way, as planned on arrival."""
        if np.linalg.norm(self.viewpoint[:3, 3] - camera[:3, 3]) < TURN_M:
            return self.viewpoint
        gaze = self.plan.look_at_m if self.plan.mode == "search" else beliefs[self.plan.target].mean_m
        heading = look_at(camera[:3, 3], gaze)
        heading[:3, 3] = self.viewpoint[:3, 3]
        return heading

    def _obstacles(self, beliefs: dict[str, Belief]) -> Spheres:
        """Spheres around what is believed to stand there."""
        known = [b for b in beliefs.values() if b.presence > 0.5 and np.trace(b.covariance_m2) < KNOWN_M ** 2]
        return spheres_around(np.array([b.mean_m for b in known]).reshape(-1, 3),
                              np.array([self.sizes_m[b.object] for b in known]).reshape(-1, 3))

    def _choose(self, stamp: Belief, beliefs: dict[str, Belief], camera: Array, spheres: Spheres) -> None:
        """Draws candidates, weighs them, takes the best."""
        rng = generator(self.config.seed, self.config.bus.world, self.episode, stamp.step, "planner")
        target = beliefs[self.preference.target] if self.preference else None
        found = target is not None and np.trace(target.covariance_m2) < FOUND_M ** 2 and target.presence > 0.5
        eyes, gazes = self._candidates(target, beliefs, camera, rng)
        eyes = np.clip(eyes, LOWER_M, UPPER_M)
        mode = "goal" if found and target.goal_log_posterior is not None else "search"
        if mode == "goal":
            best = self._goal_viewpoint(target, spheres)
            eyes, gazes = np.vstack([eyes, best[:3, 3]]), np.vstack([gazes, target.mean_m])
        preference = self.preference if found else None
        terms = expected_free_energy(eyes, gazes, beliefs, preference, self.config.planner.information_weight)
        cost = terms.total + self._visited_cost(eyes, target) if found else terms.total
        if not found:  # among views that tell the same, the nearest
            cost = cost + 0.3 * np.linalg.norm(eyes - camera[:3, 3], axis=1)
        chosen = int(np.argmin(cost))
        viewpoint = look_at(clip(eyes[chosen], spheres), gazes[chosen])
        if mode == "goal" and chosen == len(eyes) - 1:
            viewpoint = best
        elif mode == "goal":
            mode = "approach"
        self.viewpoint, self.age = viewpoint, 0
        self.plan = self._plan(stamp, mode, gazes[chosen], terms, chosen)

    def _candidates(self, target: Belief | None, beliefs: dict[str, Belief], camera: Array,
                    rng: np.random.Generator) -> tuple[Array, Array]:
        """Eyes and look-at points [N, 3]: a third from the goal posterior, a third at the goal's range, a third
        anywhere; the look-at points from the particles."""
        count = self.config.planner.candidates
        watched = [target] if target is not None else list(beliefs.values())
        clouds = np.concatenate([belief.particles_m for belief in watched]).astype(np.float64)
        gazes = clouds[rng.integers(len(clouds), size=count)]
        eyes = rng.uniform(LOWER_M, UPPER_M, (count, 3))
        if self.preference is None:
            return eyes, gazes
        third = count // 3
        reach = self.preference.range_m + rng.normal(0, 0.10, third)
        away = unit(eyes[third:2 * third] - gazes[third:2 * third])
        eyes[third:2 * third] = gazes[third:2 * third] + np.maximum(reach, 0.1)[:, None] * away
        if target.goal_log_posterior is not None:
            probabilities = np.exp(target.goal_log_posterior.astype(np.float64)).ravel()
            cells = rng.choice(len(probabilities), size=third, p=probabilities / probabilities.sum())
            elevation, azimuth = viewing_grid()
            e, a = elevation[cells // len(azimuth)], azimuth[cells % len(azimuth)]
            eyes[:third] = gazes[:third] + self.preference.range_m * direction(
                a + rng.uniform(-0.04, 0.04, third), e + rng.uniform(-0.04, 0.04, third))
        return eyes, gazes

    def _visited_cost(self, eyes: Array, target: Belief) -> Array:
        """A price on views of the target from where it was seen not to be the goal [N]."""
        cost = np.zeros(len(eyes))
        away = unit(eyes - target.mean_m)
        for seen in self.visited:
            near = np.arccos(np.clip(away @ seen, -1, 1)) / VISITED_RAD
            cost += VISITED_COST * np.exp(-0.5 * near ** 2)
        return cost

    def _goal_viewpoint(self, target: Belief, spheres: Spheres) -> Array:
        """Where the goal image was taken, as believed [4, 4]: the posterior's peak, at the goal's range, the target at
        the goal's pixel. As in the environment, the position is clipped and the view direction kept."""
        elevation, azimuth = viewing_grid()
        log_posterior = target.goal_log_posterior.astype(np.float64)
        e_grid, a_grid = np.meshgrid(elevation, azimuth, indexing="ij")
        directions = direction(a_grid, e_grid)
        for seen in self.visited:
            near = np.arccos(np.clip(directions @ seen, -1, 1)) / VISITED_RAD
            log_posterior = log_posterior - VISITED_COST * np.exp(-0.5 * near ** 2)
        peak = np.unravel_index(np.argmax(log_posterior), log_posterior.shape)
        near = directions @ directions[peak] > np.cos(0.18)
        mass = np.where(near, np.exp(log_posterior - log_posterior[peak]), 0.0)
        centre = unit((directions * mass[..., None]).sum((0, 1)))
        position = target.mean_m + self.preference.range_m * centre
        viewpoint = aim(position, target.mean_m, self.preference.pixel, self.preference.intrinsics_px)
        viewpoint[:3, 3] = clip(position, spheres)
        return viewpoint

    def _plan(self, stamp: Belief, mode: str, gaze: Array, terms: Terms, chosen: int) -> Plan:
        return Plan(
            run=stamp.run, episode=stamp.episode, step=stamp.step, mode=mode, viewpoint=self.viewpoint, look_at_m=gaze,
            target=self.preference.target if self.preference else "", g_position=float(terms.position[chosen]),
            g_scale=float(terms.scale[chosen]), g_pose=float(terms.pose[chosen]),
            g_information=float(terms.information[chosen]), candidates=len(terms.position), believed_distance_m=-1.0,
            arrived=False)

    def _publish(self, stamp: Belief, camera: Array, beliefs: dict[str, Belief], declared: bool) -> Plan:
        """The plan as it stands at this step."""
        distance = -1.0
        if self.preference and beliefs[self.preference.target].goal_log_posterior is not None:
            goal = self._goal_viewpoint(beliefs[self.preference.target], Spheres(np.zeros((0, 3)), np.zeros(0)))
            distance = float(np.linalg.norm(goal[:3, 3] - camera[:3, 3]))
        fields = {name: getattr(self.plan, name) for name in (
            "target", "mode", "look_at_m", "g_position", "g_scale", "g_pose", "g_information", "candidates")}
        return Plan(run=stamp.run, episode=stamp.episode, step=stamp.step, viewpoint=self.viewpoint,
                    believed_distance_m=distance, arrived=declared, **fields)


def _at(camera: Array, viewpoint: Array) -> bool:
    return bool(np.linalg.norm(camera[:3, 3] - viewpoint[:3, 3]) < ARRIVED_M
                and rotation_angle(camera[:3, :3], viewpoint[:3, :3]) < ARRIVED_RAD)


def build(config: Config) -> Planner:
    """The core for a run's configuration."""
    if not config.scene.names:
        raise SaccadeError("configuration key 'scene.names' is empty: name the objects to plan for")
    return Planner(config, config.scene.names)
