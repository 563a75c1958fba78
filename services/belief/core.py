"""The belief over the scene: for each instance of each object, a posterior over its position and one over the goal's
viewpoint."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from saccade.services.belief.association import (
    APART,
    BIRTH_LOG_ODDS,
    DEAD_LOG_ODDS,
    LEFT_LOG_ODDS,
    LOST_M,
    MORE,
    MOST,
    SAME,
    SURE,
    VAGUE_M,
    assigned,
    count_probabilities,
    doubles,
    is_apart,
)
from saccade.services.belief.attitude import PoseLikeness
from saccade.services.belief.instance import Instance, Kind, Others
from saccade.services.belief.motion import Change
from saccade.services.belief.pose import GoalView, LatentLikeness, Likeness, TurnLikeness
from saccade.services.belief.position import Array, Evidence, Moments, PositionFilter, evidence_of, of_whole
from saccade.shared.bus.messages import Belief, Events, Percept
from saccade.shared.bus.topics import BELIEF, EVENTS, GOAL, GOAL_PERCEPT, PERCEPT, Output
from saccade.shared.config import Config
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.model.latent import LatentTransition
from saccade.shared.model.object_card import symmetries
from saccade.shared.model.weights import WITH_LATENTS, Weights
from saccade.shared.world.place import Place, place_of

SERVICE = Service("belief", inputs=(PERCEPT, GOAL_PERCEPT, GOAL), trigger=PERCEPT, outputs=(BELIEF, EVENTS))

WORTH_COMPARING = 0.05  # chosen: an object's pose is compared with the goal if its presence in the goal image is higher


class BeliefFilter:
    """Turns percepts into beliefs. Its state, the particles and the kept views, follows from the episode's percepts.

    Of each kind there is always one instance. As long as no image has shown two, all percepts are of this one. From
    then on percepts are given to the instances that they fit (services/belief/association.py).
    Raises SaccadeError if the weights are missing or damaged, if they lack an object, or if a card is damaged.
    """

    def __init__(self, config: Config, names: tuple[str, ...]):
        self.config, self.names = config, names
        weights = Weights(config.weights)
        self.radius_m = {card.name: card.radius_m for card in weights.cards_of(names)}
        self.symmetry = symmetries(config.scene.objects, names)
        # Networks that estimate poses have no latent poses, and so no transition.
        latent = weights.architecture in WITH_LATENTS
        self.transitions = {name: LatentTransition(weights, name) for name in names} if latent else {}
        self.kinds = {name: Kind(name, self.radius_m[name], self.transitions.get(name)) for name in names}

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode. Nothing is known about its scene yet, and nothing is published."""
        self.episode, self.goal_known = episode, False
        self.place: Place | None = None
        self.goals: dict[str, tuple[Likeness, Percept]] = {}
        self.instances: dict[str, list[Instance]] = {}
        self.born = dict.fromkeys(self.names, 1)  # how many of each kind were found so far
        self.more: dict[str, Instance] = {}  # of kinds of which there were surely two: one more that was not seen yet
        return ()

    def _rng(self, step: int, what: str) -> np.random.Generator:
        return generator(self.config.seed, self.config.bus.world, self.episode, step, f"belief {what}")

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields one message per object with the beliefs about all of this kind, computed from the percepts of all
        objects at one step."""
        percepts: dict[str, Percept] = inputs["percept"]
        if not self.goal_known:
            self.goal_known, self.place = True, place_of(inputs.get("goal"))
            self.goals = {name: (likeness, goal) for name, goal in inputs["goal_percept"].items()
                          if goal.presence > WORTH_COMPARING for likeness in self._likeness(goal, self.place)}
            self.instances = {name: [self._instance(name, 1, self._rng(0, f"start {name}"))] for name in self.names}
        above = self.config.belief.present_above
        seen = {name: self._apart([p for p in percepts[name].each() if p.presence > above]) for name in self.names}
        changes: list[tuple[Instance, Change]] = []
        for name in self.names:
            told = self._update(name, percepts[name], seen, changes)
            counts = count_probabilities([belief.presence for belief in told])
            yield Output(BELIEF, replace(told[0], further=told[1:], count_probabilities=counts), name)
        yield Output(EVENTS, _events(percepts[self.names[0]], changes))

    def _apart(self, percepts: list[Percept]) -> list[Percept]:
        """Percepts of one kind in one image, the likeliest first, without those of the same thing once more."""
        kept: list[tuple[Percept, Array]] = []
        for percept in percepts:
            place = evidence_of(percept).mean
            if is_apart(place, [other for _, other in kept], SAME * self.radius_m[percept.object]):
                kept.append((percept, place))
        return [percept for percept, _ in kept]

    def _likeness(self, goal: Percept, place: Place | None) -> list[Likeness]:
        """How views of an object are compared with its percept in the goal image. Empty if they cannot be. In a place
        of its own an object may lie, and the goal's camera may have been rolled."""
        if goal.rotations is not None and place is not None:
            return [PoseLikeness(goal, self.symmetry[goal.object])]
        if goal.rotations is not None:
            return [TurnLikeness(goal, self.symmetry[goal.object])]
        direct = self.config.belief.pose != "last"  # the paper's agent has the transition alone
        return [LatentLikeness(self.transitions[goal.object], goal, direct=direct)] if len(goal.latent_mean) else []

    def _instance(self, name: str, number: int, rng: np.random.Generator, prior: float = 0.5) -> Instance:
        """A new instance. Nothing is known of it but the `prior` probability that it is there."""
        goal_view = None
        if name in self.goals:
            likeness, goal = self.goals[name]
            goal_view = GoalView(self.config.belief, likeness, goal, self.symmetry[name])
        position = PositionFilter(self.config.belief, rng, self.place, prior)
        return Instance(self.kinds[name], number, self.config.belief, position, goal_view)

    def _update(self, name: str, percept: Percept, seen: dict[str, list[Percept]],
                changes: list[tuple[Instance, Change]]) -> list[Belief]:
        """The beliefs about all instances of a kind after an image, of which `percept` is the kind's likeliest."""
        step, instances = percept.step, self.instances[name]
        rngs = {instance.number: self._rng(step, instance.label) for instance in instances}
        for instance in instances:
            instance.carry(step, rngs[instance.number])
        several = name in self.more or len(instances) > 1 or len(seen[name]) > 1
        numbers = self._assigned(name, seen) if several else [0 if seen[name] else None]
        unseen = replace(percept, presence=0.0, goal_agreement=None, further=[]) if several else percept
        told: dict[int, Belief] = {}
        for instance, number in zip(instances, numbers, strict=True):
            mine = unseen if number is None else seen[name][number]
            told[instance.number], change = self._take(instance, mine, number is not None, seen,
                                                       rngs[instance.number], alone=not several)
            changes += [] if change is None else [(instance, change)]
        if not several and instances[0].left is not None:
            self._leave(name, instances[0].left, step)
        if several:
            rest = [p for k, p in enumerate(seen[name]) if k not in numbers]
            for instance, mine, rng in self._births(name, rest, seen):
                told[instance.number], _ = self._take(instance, mine, True, seen, rng, alone=False)
            self._bury(name)
        return [told[i.number] for i in self.instances[name] if i.number in told] + self._one_more(name, unseen, seen)

    def _one_more(self, name: str, unseen: Percept, seen: dict[str, list[Percept]]) -> list[Belief]:
        """Where there are several there may be one more, where nobody has looked yet."""
        if sum(i.position.presence > SURE for i in self.instances[name]) < 2 and name not in self.more:
            return []
        number = self.born[name] + 1
        rng = self._rng(unseen.step, f"{name}#{number} unseen")
        if name not in self.more:
            self.more[name] = self._instance(name, number, rng, MORE)
            self.more[name].position.unseen = None  # where several are, one may well be at the table's edge
        self.more[name].number = number
        return [self._take(self.more[name], unseen, False, seen, rng, alone=False)[0]]

    def _take(self, instance: Instance, percept: Percept, is_seen: bool, seen: dict[str, list[Percept]],
              rng: np.random.Generator, *, alone: bool) -> tuple[Belief, Change | None]:
        """Updates one instance. Returns what is believed about it, and what happened to it."""
        single = replace(percept, further=[]) if percept.further else percept
        return instance.update(single, is_seen, self._others(instance.kind.name, percept, seen), rng, alone=alone)

    def _leave(self, name: str, place: Moments, step: int) -> None:
        """One of a kind was seen elsewhere, and nobody has looked where it was: perhaps there are two."""
        self.born[name] += 1
        rng = self._rng(step, f"{name}#{self.born[name]}")
        instance = self._instance(name, self.born[name], rng)
        instance.position.placed(*place, rng)
        instance.position.log_odds = LEFT_LOG_ODDS
        self.instances[name].append(instance)

    def _others(self, name: str, percept: Percept, seen: dict[str, list[Percept]]) -> Others:
        """What else is seen beside a percept of a kind: it may hide what is behind it."""
        return [(evidence_of(other), self.radius_m[kind]) for kind in sorted(seen) for other in seen[kind]
                if other is not percept]

    def _evidence(self, percept: Percept, seen: dict[str, list[Percept]]) -> Evidence:
        return of_whole(percept, self.radius_m[percept.object], self._others(percept.object, percept, seen))

    def _assigned(self, name: str, seen: dict[str, list[Percept]]) -> list[int | None]:
        places = [instance.position.moments() for instance in self.instances[name]]
        return assigned(places, [self._evidence(percept, seen) for percept in seen[name]])

    def _births(self, name: str, percepts: list[Percept],
                seen: dict[str, list[Percept]]) -> Iterable[tuple[Instance, Percept, np.random.Generator]]:
        """Yields the instances that begin with percepts which are of no other, in the order of their presence."""
        for percept in percepts:
            evidence, instances = self._evidence(percept, seen), self.instances[name]
            means = [instance.position.moments()[0] for instance in instances]
            vague = np.trace(evidence.covariance) > VAGUE_M ** 2
            if vague or len(instances) >= MOST or not is_apart(evidence.mean, means, APART * self.radius_m[name]):
                continue
            self.born[name] += 1
            rng = self._rng(percept.step, f"{name}#{self.born[name]}")
            instance = self._instance(name, self.born[name], rng)
            instance.position.placed(evidence.mean, 4.0 * evidence.covariance, rng)  # the percept itself comes next
            instance.position.log_odds = -BIRTH_LOG_ODDS
            instances.append(instance)
            yield instance, percept, rng

    def _bury(self, name: str) -> None:
        """Drops the instances that are not there any more, and those that are another one once more. One is left."""
        instances = self.instances[name]
        alive = [i for i in instances if i.position.log_odds > DEAD_LOG_ODDS
                 and np.trace(i.position.moments()[1]) < LOST_M ** 2]
        places, presences = [i.position.moments() for i in alive], [i.position.presence for i in alive]
        twice = doubles(places, presences, SAME * self.radius_m[name])
        alive = [instance for k, instance in enumerate(alive) if k not in twice]
        self.instances[name] = alive or [max(instances, key=lambda i: i.position.log_odds)]


def _events(at: Percept, changes: list[tuple[Instance, Change]]) -> Events:
    """The message of what was noticed with the image of a percept."""
    return Events(run=at.run, episode=at.episode, step=at.step, objects=[i.kind.name for i, _ in changes],
                  kinds=[change.kind for _, change in changes],
                  positions_m=np.array([change.place for _, change in changes]).reshape(-1, 3),
                  probabilities=np.array([change.probability for _, change in changes]),
                  instances=np.array([i.number for i, _ in changes], dtype=np.uint8))


def build(config: Config) -> BeliefFilter:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights do not serve its objects."""
    return BeliefFilter(config, config.names)
