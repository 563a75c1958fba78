"""The belief over the scene: for each object, a posterior over its position and one over the goal's viewpoint."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from saccade.services.belief.attitude import PoseLikeness, Views
from saccade.services.belief.free_energy import crop_term, identity_term, likelihood_term, pose_term, position_term
from saccade.services.belief.motion import Change, Motion
from saccade.services.belief.pose import GoalView, LatentLikeness, Likeness, TurnLikeness
from saccade.services.belief.position import Evidence, PositionFilter, evidence_of, of_whole
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

Moments = tuple[NDArray[np.float64], NDArray[np.float64]]  # mean [3], covariance [3, 3]

WORTH_COMPARING = 0.05  # chosen: an object's pose is compared with the goal if its presence in the goal image is higher
UNKNOWN, SHOWN = 0.5, 0.9  # chosen: prior probabilities that an object is there, and that one the goal image shows is
LOCALISED_M = 0.08  # chosen: a view is used for the pose only if the deviation of the object's position is smaller


class Energy(TypedDict, total=False):
    """The terms of the variational free energy F that a step has. The names are those of the fields of `Belief`."""

    f_identity: float
    f_position: float
    f_crop: float
    f_likelihood: float
    f_pose: float


class BeliefFilter:
    """Turns percepts into beliefs. Its state, the particles and the kept views, follows from the episode's percepts.

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

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode. Nothing is known about its scene yet, and nothing is published."""
        self.episode = episode
        self.positions: dict[str, PositionFilter] = {}
        self.motions = {name: Motion() for name in self.names}
        self.since = dict.fromkeys(self.names, 0)
        self.seen_last: set[str] = set()  # objects that were seen in the last image
        self.goal_views: dict[str, GoalView] = {}
        self.last_seen: dict[str, Percept] = {}
        self.goal_known = False
        return ()

    def _rng(self, step: int, what: str) -> np.random.Generator:
        return generator(self.config.seed, self.config.bus.world, self.episode, step, f"belief {what}")

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields one belief per object, computed from the percepts of all objects at one step."""
        percepts: dict[str, Percept] = inputs["percept"]
        if not self.goal_known:
            self.goal_known, place = True, place_of(inputs.get("goal"))
            self.positions = {
                name: PositionFilter(self.config.belief, self._rng(0, f"start {name}"), place,
                                     float(np.clip(goal.presence, UNKNOWN, SHOWN)))
                for name, goal in ((name, inputs["goal_percept"][name]) for name in self.names)}
            self.goal_views = {
                name: GoalView(self.config.belief, likeness, goal, self.symmetry[name])
                for name, goal in inputs["goal_percept"].items() if goal.presence > WORTH_COMPARING
                for likeness in self._likeness(goal, place)}
        present = {name for name in self.names if percepts[name].presence > self.config.belief.present_above}
        changes: dict[str, Change] = {}
        for name in self.names:
            yield Output(BELIEF, self._update(name, percepts, present, changes), name)
        self.seen_last = present
        yield Output(EVENTS, _events(percepts[self.names[0]], changes))

    def _likeness(self, goal: Percept, place: Place | None) -> list[Likeness]:
        """How views of an object are compared with its percept in the goal image. Empty if they cannot be. In a place
        of its own an object may lie, and the goal's camera may have been rolled."""
        if goal.rotations is not None and place is not None:
            return [PoseLikeness(goal, self.symmetry[goal.object])]
        if goal.rotations is not None:
            return [TurnLikeness(goal, self.symmetry[goal.object])]
        direct = self.config.belief.pose != "last"  # the paper's agent has the transition alone
        return [LatentLikeness(self.transitions[goal.object], goal, direct=direct)] if len(goal.latent_mean) else []

    def _update(self, name: str, percepts: dict[str, Percept], present: set[str],
                changes: dict[str, Change]) -> Belief:
        percept, position = percepts[name], self.positions[name]
        rng = self._rng(percept.step, name)
        others = [(evidence_of(percepts[other]), self.radius_m[other]) for other in sorted(present - {name})]
        self._carry(name, percept.step, rng)
        visible = position.visible(percept.world_from_camera, percept.intrinsics_px, others)
        before, prior = position.moments(), position.expected(visible)
        if name in present:
            position.seen(percept, rng)
        else:
            position.missed(visible, rng)
            position.not_found(percept.world_from_camera, percept.intrinsics_px, others)
        change = self._notice(name, percept, name in present, others, rng)
        if change is not None:
            changes[name] = change
        mean, covariance = position.moments()
        goal_view = self.goal_views.get(name)
        posterior, goal_range_m, goal_here = None, 0.0, 0.0
        if goal_view is not None:
            if name in present and np.trace(covariance) < LOCALISED_M ** 2:
                goal_view.seen(percept, mean)
            posterior = goal_view.log_posterior()
            if posterior is not None:
                goal_range_m = goal_view.range_m(posterior)
                goal_here = goal_view.here(percept) if name in present else 0.0
        energy = self._free_energy(percept, prior, before, (mean, covariance), name in present)
        return Belief(
            run=percept.run, episode=percept.episode, step=percept.step, object=name, presence=position.presence,
            world_from_camera=np.array(percept.world_from_camera), mean_m=mean, covariance_m2=covariance,
            particles_m=position.sample(self.config.belief.published_particles, rng).astype(np.float32),
            views=len(goal_view.keyframes) if goal_view else 0,
            goal_log_posterior=None if posterior is None else posterior.astype(np.float32),
            goal_range_m=goal_range_m, goal_here=goal_here, goal_agreement=percept.goal_agreement,
            velocity_m=self.motions[name].velocity_m, since_step=self.since[name],
            **_told(goal_view.views if goal_view else None), **energy)

    def _carry(self, name: str, step: int, rng: np.random.Generator) -> None:
        """Moves the belief about an object that drifts on by one step."""
        velocity_m = self.motions[name].velocity_m
        if velocity_m is None:
            return
        self.positions[name].carried(velocity_m, name in self.seen_last, rng)
        if name in self.goal_views:
            self.goal_views[name].carried(velocity_m, step)

    def _notice(self, name: str, percept: Percept, seen: bool, others: list[tuple[Evidence, float]],
                rng: np.random.Generator) -> Change | None:
        """What is noticed to have happened to an object. The belief about it then begins anew where it has to."""
        motion, position = self.motions[name], self.positions[name]
        clear = position.clear(motion.places, percept.world_from_camera, percept.intrinsics_px, others)
        evidence = of_whole(percept, self.radius_m[name], others) if seen else None
        change = motion.step(percept.step, evidence, percept.presence, clear)
        if change is None:
            return None
        if change.kind == "gone":
            position.lost(rng)
        elif change.kind != "rests":
            position.placed(change.place, change.covariance, rng)
            self.since[name] = percept.step
        if change.kind == "moved" and name in self.goal_views:
            self.goal_views[name].forget()
        return change

    def _free_energy(self, percept: Percept, prior: float, before: Moments, after: Moments,
                     present: bool) -> Energy:
        """The terms of F at this step. An object that is not seen has only the identity and the position term.

        `prior` is the probability that the object was expected in this view. `before` and `after` are the moments of
        its position before and after the image.
        """
        terms: Energy = {"f_identity": identity_term(percept.presence, prior),
                         "f_position": position_term(before, after)}
        if not present:
            return terms
        last, name = self.last_seen.get(percept.object), percept.object
        self.last_seen[name] = percept
        terms |= {"f_crop": crop_term(percept, before), "f_likelihood": likelihood_term(percept)}
        if len(percept.latent_mean):
            terms["f_pose"] = pose_term(percept, last, after[0], self.transitions[name])
        return terms


class ToldViews(TypedDict, total=False):
    """The fields of `Belief` about how the goal's camera was turned."""

    goal_rotations: NDArray[np.float64]
    goal_rotations_log_probability: NDArray[np.float64]


def _told(views: Views | None) -> ToldViews:
    if views is None:
        return {}
    return {"goal_rotations": views.rotations, "goal_rotations_log_probability": views.log_probability}


def _events(at: Percept, changes: dict[str, Change]) -> Events:
    """The message of what was noticed with the image of a percept."""
    return Events(run=at.run, episode=at.episode, step=at.step, objects=list(changes),
                  kinds=[change.kind for change in changes.values()],
                  positions_m=np.array([change.place for change in changes.values()]).reshape(-1, 3),
                  probabilities=np.array([change.probability for change in changes.values()]))


def build(config: Config) -> BeliefFilter:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights do not serve its objects."""
    return BeliefFilter(config, config.names)
