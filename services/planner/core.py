"""Chooses viewpoints with minimal expected free energy and moves there in short steps (paper, section 3.3).

The planner draws candidate viewpoints. Most of them look at the believed position of the target, from directions from
which it would look as in the goal image. The viewpoint is chosen anew every few steps and on arrival. When the camera
arrives at the believed goal, the agent says so. If it is still asked to act, it moves on to the next likely viewpoint.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from saccade.services.planner.arrival import Arrival
from saccade.services.planner.candidates import draw
from saccade.services.planner.free_energy import Terms, expected_free_energy
from saccade.services.planner.goal import Preference, infer_preference
from saccade.services.planner.goal_views import Side, goal_eye, goal_viewpoint, heading
from saccade.services.planner.hand import Hand
from saccade.services.planner.instances import Tried, best_of, flat, score
from saccade.services.planner.moving import OFTEN, ahead, carried, shifted
from saccade.services.planner.place import Ground, PaperGround, Room, way_cost
from saccade.shared.bus.messages import Action, Belief, Plan
from saccade.shared.bus.topics import ACTION, BELIEF, GOAL, GOAL_PERCEPT, PLAN, Output
from saccade.shared.config import Config
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.model.object_card import symmetries
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import Array, look_at, rotation_angle, rotation_towards
from saccade.shared.world.place import place_of
from saccade.shared.world.task import Spheres, spheres_around, success
from saccade.shared.world.workspace import Boxes

SERVICE = Service("planner", inputs=(BELIEF, GOAL_PERCEPT, GOAL), trigger=BELIEF, outputs=(PLAN, ACTION))

PRESENT = 0.5  # derived: an object counts as present if this is likelier than not
FOUND_M = 0.06  # chosen: the target counts as found if the deviation of its position is below this
KNOWN_M = 0.10  # chosen: an object becomes an obstacle if the deviation of its position is below this
ARRIVED_M = 0.01  # chosen: the camera has arrived if it is within this distance of its viewpoint and within ARRIVED_RAD
ARRIVED_RAD = 0.05  # chosen: the camera has arrived if it is within this angle of its viewpoint and within ARRIVED_M
STUCK_M = 0.002  # chosen: a camera that moves less than this in a step counts as arrived, because it cannot come nearer
TURN_M = 0.10  # chosen: nearer than this to its viewpoint the camera turns as planned; before, it looks at the target
VISITED_M = 0.05  # chosen: viewpoints within about this distance of one that was not the goal's also become costly
VISITED_RAD = 0.35  # chosen: viewpoints within about this angle of one that was not the goal's also become costly
VISITED_COST = 6.0  # chosen: nats that are added to the cost of a viewpoint that was not the goal's
DOUBT_LIMIT = 2.5  # chosen: after wrong viewpoints the goal's log posterior is divided by at most this
PUBLISHED = 64  # number of candidates in a plan message; it changes nothing that the agent does


class Planner:
    """Turns beliefs into plans and actions.

    Raises SaccadeError if the weights are missing or damaged, if they lack an object, or if a card is damaged.
    """

    def __init__(self, config: Config, names: tuple[str, ...]):
        self.config, self.names, self.symmetry = config, names, symmetries(config.scene.objects, names)
        self.moved_by = config.planner.moved_by or ("recording" if config.camera.source is not None else "agent")
        self.ends_at_goal = (self.moved_by == "agent" and config.simulator.until == "reached"
                             and config.scene.goal_image is None)
        self.sizes_m = {card.name: card.size_m for card in Weights(config.weights).cards_of(names)}

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode with a new goal. Nothing is published."""
        self.episode, self.goal_known = episode, False
        self.preference: Preference | None = None
        self.plan: Plan | None = None  # as it was when it was chosen
        self.age = 0  # steps since the plan was chosen
        self.before: Array | None = None  # pose of the camera at the last step [4, 4]
        self.hand = Hand(self.config.planner.replan_every) if self.moved_by == "hand" else None
        self.target_instance = 1  # the one of the target's kind that the agent goes for
        self.tried = {1: Tried()}  # by the number of the instance
        self.velocity_m: Array | None = None  # of the target, as believed [3]
        self.arrival = Arrival(self.symmetry, retry=self.config.planner.retry, moved_by=self.moved_by,
                               ends_at_goal=self.ends_at_goal)
        return ()

    @property
    def now(self) -> Tried:
        """What was tried at the instance that the agent goes for."""
        return self.tried[self.target_instance]

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields a plan and an action, computed from the beliefs about all objects at one step."""
        told: dict[str, Belief] = inputs["belief"]
        stamp = told[self.names[0]]
        camera = stamp.world_from_camera
        if not self.goal_known:
            self.goal_known = True
            place = place_of(inputs.get("goal"))
            self.room = None if place is None else Room(place)
            preference = infer_preference(inputs["goal_percept"], self.config.planner.range_std_m)
            self.confidence = preference.confidence
            # A goal image that shows no known object sets no preference. The agent then explores.
            known = preference.confidence >= self.config.planner.goal_confidence
            self.preference = preference if known and not self.config.scene.explore else None
        beliefs = self._follow(self._one_of_each(told, camera))
        spheres = self.obstacles(beliefs)
        ground = self._ground(beliefs)
        beliefs = self._refine(beliefs, ground)
        if self.preference is not None:
            self.arrival.see(beliefs[self.preference.target], self.now)
        chosen, mode, eye = self.plan, self._mode(beliefs), self._believed_eye(beliefs, camera, ground)
        moved = self._moved if self.hand is None else self._followed
        due, declared = moved(chosen, mode, beliefs, camera, None if eye is None else ground.nearest(eye))
        if chosen is not None:
            chosen = self.plan = carried(chosen, self.velocity_m)
        if chosen is None or due:
            chosen = self.plan = self._choose(stamp, mode, beliefs, camera, ground)
            if self.hand is not None:
                chosen = self.plan = replace(chosen, viewpoint=self.hand.follow(chosen.viewpoint, spheres, eye))
        if self.hand is not None and declared:  # the goal's view may be elsewhere than it was believed to be
            chosen = self.plan = replace(chosen, viewpoint=self.hand.viewpoint)
        self.before = camera
        translation, rotation = ground.step(camera, self._heading(camera, chosen, beliefs), self.config.planner.step_m)
        if declared:  # the agent is judged at the pose at which it says that it has arrived, so it must not move
            translation, rotation = np.zeros(3), np.zeros(3)
        distance = -1.0 if eye is None else float(np.linalg.norm(eye - camera[:3, 3]))
        plan = replace(chosen, step=stamp.step, believed_distance_m=distance, arrived=declared)
        yield Output(PLAN, plan)
        yield Output(ACTION, Action(run=plan.run, episode=plan.episode, step=plan.step, translation_m=translation,
                                    rotation_rad=rotation, arrived=declared))

    def _one_of_each(self, told: dict[str, Belief], camera: Array) -> dict[str, Belief]:
        """The beliefs about all instances, with the best one of the target's kind under the target's name."""
        if self.preference is None:
            return flat(told, None, 1)
        target, each, scores = self.preference.target, told[self.preference.target].each(), {}
        if [belief.instance for belief in each] == [self.target_instance]:
            return flat(told, target, self.target_instance)
        for belief in each:
            beliefs = flat(told, target, belief.instance)
            ground = self._ground(beliefs)
            eye = goal_eye(belief, self.preference, self.symmetry[target], camera, ground)
            blocked = eye is not None and bool(ground.is_blocked(eye[None])[0])
            scores[belief.instance] = score(belief, eye, camera, self.tried.get(belief.instance), is_blocked=blocked)
        number = best_of(scores, self.target_instance)
        if number != self.target_instance:
            self.target_instance, self.plan = number, None
            self.tried.setdefault(number, Tried())
        return flat(told, target, number)

    def _ground(self, beliefs: dict[str, Belief]) -> Ground:
        """Where the camera can be among the objects of these beliefs."""
        return PaperGround(self.obstacles(beliefs)) if self.room is None else self.room.among(self._boxes(beliefs))

    def _follow(self, beliefs: dict[str, Belief]) -> dict[str, Belief]:
        """Takes what happened to the target, and returns the beliefs as they will be at the next image.

        What was tried before the target was moved says nothing any more. While it drifts, it moves along.
        """
        target = self.preference.target if self.preference else None
        if target is None:
            return beliefs
        if beliefs[target].since_step > self.now.since:
            self.plan, self.tried[self.target_instance] = None, Tried(beliefs[target].since_step)
        self.velocity_m = velocity_m = beliefs[target].velocity_m
        if velocity_m is not None:
            self.now.visited = [shifted(seen, velocity_m) for seen in self.now.visited]
        return ahead(beliefs, target)

    def _refine(self, beliefs: dict[str, Belief], ground: Ground) -> dict[str, Belief]:
        """Takes the goal's range from the belief, which corrects it by the error that similar views have. Returns the
        beliefs with what the place says of the goal's view."""
        if self.preference is None:
            return beliefs
        target = beliefs[self.preference.target]
        if target.goal_range_m > 0:
            self.preference = replace(self.preference, range_m=target.goal_range_m)
        told = ground.told(target, self.preference, np.asarray(self.sizes_m[target.object]))
        return beliefs | {target.object: told}

    def _moved(self, chosen: Plan | None, mode: str, beliefs: dict[str, Belief], camera: Array,
               eye: Array | None) -> tuple[bool, bool]:
        """Whether the plan is to be renewed, and whether the agent says that it has arrived."""
        arrived, declared = chosen is not None and self._arrived(camera, chosen.viewpoint), False
        if chosen is not None and arrived and chosen.mode == "goal":
            declared = self.arrival.judge(beliefs[chosen.target], camera, self.now, eye)
        self.age += 1
        due = chosen is None or arrived or mode != chosen.mode or self.age >= self._patience
        return due, declared

    @property
    def _patience(self) -> int:
        """After how many steps a viewpoint is chosen anew."""
        return self.config.planner.replan_every if self.velocity_m is None else OFTEN

    def _followed(self, chosen: Plan | None, mode: str, beliefs: dict[str, Belief], camera: Array,
                  eye: Array | None) -> tuple[bool, bool]:
        """The same for a hand."""
        if self.hand is None or chosen is None or (mode != chosen.mode and not self.hand.there):
            return True, False
        target = beliefs[chosen.target] if chosen.mode == "goal" else None
        return self.arrival.judge_hand(self.hand, target, camera, self.now, eye)

    def _arrived(self, camera: Array, viewpoint: Array) -> bool:
        """Whether the camera is at the viewpoint, or as near as it can come."""
        if self.moved_by == "recording":  # nobody follows the plan, so the task's tolerance counts
            return success(camera, viewpoint)
        moved = _between(camera, self.before) if self.before is not None and self.age > 1 else (1.0, 1.0)
        near = _between(camera, viewpoint)
        within = ARRIVED_M if self.velocity_m is None else ARRIVED_M + float(np.linalg.norm(self.velocity_m))
        return (near[0] < within and near[1] < ARRIVED_RAD) or (moved[0] < STUCK_M and moved[1] < ARRIVED_RAD)

    def _heading(self, camera: Array, plan: Plan, beliefs: dict[str, Belief]) -> Array:
        """The camera pose to move towards [4, 4].

        Its position is that of the viewpoint. On the way the camera looks at the target (at the plan's look-at point
        while it searches), and near the viewpoint it takes the planned attitude.
        """
        if np.linalg.norm(plan.viewpoint[:3, 3] - camera[:3, 3]) < TURN_M:
            return plan.viewpoint
        gaze = plan.look_at_m if plan.mode == "search" else beliefs[plan.target].mean_m
        rolled = plan.mode == "goal" and beliefs[plan.target].goal_rotations is not None
        return heading(camera, plan.viewpoint, gaze, rolled=rolled)

    def obstacles(self, beliefs: dict[str, Belief]) -> Spheres:
        """Spheres around the objects whose presence and position the agent is sure of."""
        known = _known(beliefs)
        return spheres_around(np.array([b.mean_m for b in known]).reshape(-1, 3),
                              np.array([self.sizes_m[b.object] for b in known]).reshape(-1, 3))

    def _boxes(self, beliefs: dict[str, Belief]) -> Boxes:
        """Boxes around the same objects. They are as wide to all sides, because it is not known how they are turned."""
        known = _known(beliefs)
        sizes = np.array([self.sizes_m[b.object] for b in known], dtype=np.float64).reshape(-1, 3)
        sizes[:, :2] = sizes[:, :2].mean(1, keepdims=True)
        return Boxes(np.array([b.mean_m for b in known]).reshape(-1, 3), np.tile(np.eye(3), (len(known), 1, 1)), sizes)

    def _mode(self, beliefs: dict[str, Belief]) -> str:
        """The mode of the plan.

        `search`: the target is not found yet. `approach`: it is found, but there is no posterior over the goal's
        direction yet. `goal`: there is one.
        """
        target = beliefs[self.preference.target] if self.preference else None
        if target is None or np.trace(target.covariance_m2) > FOUND_M ** 2 or target.presence <= PRESENT:
            return "search"
        return "approach" if target.goal_log_posterior is None else "goal"

    def _choose(self, stamp: Belief, mode: str, beliefs: dict[str, Belief], camera: Array, ground: Ground) -> Plan:
        """Draws candidate viewpoints, computes their cost and returns the plan with the best one."""
        rng = generator(self.config.seed, self.config.bus.world, self.episode, stamp.step, "planner")
        found, best = self.preference if mode != "search" else None, None
        eyes, gazes = draw(beliefs, self.preference, self._doubt, self.config.planner.candidates, ground, rng)
        believed = self._believed_eye(beliefs, camera, ground)
        if found is not None and believed is not None:
            target = beliefs[found.target]
            eye = believed if self.now.wanted is None else target.mean_m + found.range_m * self.now.wanted
            best, side = self._goal_viewpoint(found, target, eye), self._side(target, eye)
            eyes, gazes = np.vstack([side.eyes(eyes), best[:3, 3]]), np.vstack([gazes, target.mean_m])
        eyes = ground.within(eyes)
        terms = expected_free_energy(eyes, gazes, beliefs, found, self.config.planner.information_weight)
        if found is not None:  # after each wrong viewpoint, pose and scale are trusted less, so others are tried
            cost = (terms.pose + terms.scale) / self._doubt + terms.position + terms.information
            cost = cost + self._visited_cost(eyes, self._side(beliefs[found.target], eyes[-1]))
        else:  # of equally informative viewpoints the nearest is taken
            cost = terms.total + way_cost(eyes, camera)
        cost = cost + ground.hidden_cost(eyes, gazes)
        leads = best is not None and (self.now.wanted is not None or self.now.is_near)
        chosen = len(eyes) - 1 if leads else ground.best(cost, eyes, camera)
        if found is None or best is None:
            viewpoint = look_at(ground.nearest(eyes[chosen]), gazes[chosen])
        elif chosen == len(eyes) - 1:
            viewpoint = best
        else:
            viewpoint = self._goal_viewpoint(found, beliefs[found.target], eyes[chosen])
        self.age = 0
        leading = np.argsort(cost)[:PUBLISHED]
        return replace(self._plan(stamp, mode, viewpoint, gazes[chosen], terms, chosen),
                       best_eyes_m=eyes[leading].astype(np.float32), best_g=terms.total[leading].astype(np.float32))

    @property
    def _doubt(self) -> float:
        """What the goal's log posterior is divided by, at least 1.

        It grows with every wrong viewpoint. It has a limit, because otherwise the agent would forget what it knows.
        """
        return min(1.0 + len(self.now.visited), DOUBT_LIMIT)

    def _side(self, target: Belief, eye: Array) -> Side:
        return Side(target.mean_m, self.symmetry[target.object], eye)

    def _visited_cost(self, eyes: Array, side: Side) -> Array:
        """Cost [N] (nats) of views of the target from `eyes` [N, 3] that are like views that were not the goal's."""
        cost = np.zeros(len(eyes))
        if not self.now.visited:
            return cost
        rotations = rotation_towards(side.center - eyes)
        for seen in map(side.pose, self.now.visited):
            far = ((eyes - seen[:3, 3]) ** 2).sum(1) / VISITED_M ** 2
            turned = (rotation_angle(rotations, seen[:3, :3]) / VISITED_RAD) ** 2
            cost += VISITED_COST * np.exp(-0.5 * (far + turned))
        return cost

    def _believed_eye(self, beliefs: dict[str, Belief], camera: Array, ground: Ground) -> Array | None:
        """Where the goal's view is believed to be [3]. None if nothing is known of it."""
        if self.preference is None:
            return None
        target = beliefs[self.preference.target]
        return goal_eye(target, self.preference, self.symmetry[target.object], camera, ground)

    def _goal_viewpoint(self, preference: Preference, target: Belief, eye: Array) -> Array:
        return goal_viewpoint(target, preference, eye, goal_pixel=self.config.planner.goal_pixel)

    def _plan(self, stamp: Belief, mode: str, viewpoint: Array, gaze: Array, terms: Terms, chosen: int) -> Plan:
        return Plan(
            run=stamp.run, episode=stamp.episode, step=stamp.step, mode=mode, viewpoint=viewpoint, look_at_m=gaze,
            target=self.preference.target if self.preference else "", target_instance=self.target_instance,
            g_position=float(terms.position[chosen]),
            g_scale=float(terms.scale[chosen]), g_pose=float(terms.pose[chosen]),
            g_information=float(terms.information[chosen]), candidates=len(terms.position), believed_distance_m=-1.0,
            goal_confidence=self.confidence,
            arrived=False)


def _known(beliefs: dict[str, Belief]) -> list[Belief]:
    """The beliefs about objects whose presence and position the agent is sure of."""
    return [b for b in beliefs.values() if b.presence > PRESENT and np.trace(b.covariance_m2) < KNOWN_M ** 2]


def _between(a: Array, b: Array) -> tuple[float, float]:
    """Distance (metres) and angle (radians) between two poses [4, 4]."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(rotation_angle(a[:3, :3], b[:3, :3]))


def build(config: Config) -> Planner:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights do not serve its objects."""
    return Planner(config, config.names)
