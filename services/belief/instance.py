"""What is believed about one instance: where it is, whether it is there, what happened to it, and how it is turned."""

from __future__ import annotations

from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from saccade.services.belief.attitude import Views
from saccade.services.belief.free_energy import crop_term, identity_term, likelihood_term, pose_term, position_term
from saccade.services.belief.motion import Change, Motion
from saccade.services.belief.pose import GoalView
from saccade.services.belief.position import Evidence, Moments, PositionFilter, of_whole, wholly_hiding
from saccade.shared.bus.messages import Belief, Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.model.latent import LatentTransition
from saccade.shared.wording import label_of

Others = list[tuple[Evidence, float]]  # what else is seen, with its radii (m)

LOCALISED_M = 0.08  # chosen: a view is used for the pose only if the deviation of the object's position is smaller


class Kind(NamedTuple):
    """What all of a kind share: a name, a radius (m), and the transition of the latent pose, if there is one."""

    name: str
    radius_m: float
    transition: LatentTransition | None


class Energy(TypedDict, total=False):
    """The terms of the variational free energy F that a step has. The names are those of the fields of `Belief`."""

    f_identity: float
    f_position: float
    f_crop: float
    f_likelihood: float
    f_pose: float


class Instance:
    """One of a kind. `number` counts those of its kind that were found in the episode, from 1."""

    def __init__(self, kind: Kind, number: int, config: BeliefConfig, position: PositionFilter,
                 goal_view: GoalView | None):
        self.kind, self.number, self.config = kind, number, config
        self.position, self.goal_view, self.motion = position, goal_view, Motion()
        self.since = 0
        self.last_seen: Percept | None = None
        self.was_seen = False  # in the last image
        # Where it was before this image, if it is seen elsewhere and that place is not in view: it may be there, too
        self.left: Moments | None = None

    @property
    def label(self) -> str:
        """Its name, with its number if it is not the first."""
        return label_of(self.kind.name, self.number)

    def carry(self, step: int, rng: np.random.Generator) -> None:
        """Moves the belief on by one step if the object drifts."""
        velocity_m = self.motion.velocity_m
        if velocity_m is None:
            return
        self.position.carried(velocity_m, self.was_seen, rng)
        if self.goal_view is not None:
            self.goal_view.carried(velocity_m, step)

    def update(self, percept: Percept, seen: bool, others: Others, rng: np.random.Generator, *,
               alone: bool = True) -> tuple[Belief, Change | None]:
        """Takes one image, in which it is `seen` by a percept or not. A percept that does not see it tells of the
        camera. Returns what is believed, and what is noticed to have happened. Of one that is not `alone` of its kind
        nothing is noticed: what is elsewhere is another one."""
        position = self.position
        visible = position.visible(percept.world_from_camera, percept.intrinsics_px, others)
        before, prior = position.moments(), position.expected(visible)
        if seen:
            position.seen(percept, rng)
        else:
            position.missed(visible, rng)
            position.not_found(percept.world_from_camera, percept.intrinsics_px, others)
        self.left, change = None, None
        if alone:
            change = self._notice(percept, seen, others, rng)
        else:
            self.motion = Motion()
        mean, covariance = position.moments()
        posterior, goal_range_m, goal_here = None, 0.0, 0.0
        if self.goal_view is not None:
            if seen and np.trace(covariance) < LOCALISED_M ** 2:
                self.goal_view.seen(percept, mean)
            posterior = self.goal_view.log_posterior()
            if posterior is not None:
                goal_range_m = self.goal_view.range_m(posterior)
                goal_here = self.goal_view.here(percept) if seen else 0.0
        energy = self._free_energy(percept, prior, before, (mean, covariance), seen)
        self.was_seen = seen
        return Belief(
            run=percept.run, episode=percept.episode, step=percept.step, object=self.kind.name,
            presence=position.presence, world_from_camera=np.array(percept.world_from_camera), mean_m=mean,
            covariance_m2=covariance,
            particles_m=position.sample(self.config.published_particles, rng).astype(np.float32),
            views=len(self.goal_view.keyframes) if self.goal_view else 0,
            goal_log_posterior=None if posterior is None else posterior.astype(np.float32),
            goal_range_m=goal_range_m, goal_here=goal_here, goal_agreement=percept.goal_agreement,
            velocity_m=self.motion.velocity_m, since_step=self.since, instance=self.number,
            **_told(self.goal_view.views if self.goal_view else None), **energy), change

    def _notice(self, percept: Percept, seen: bool, others: Others, rng: np.random.Generator) -> Change | None:
        """What is noticed to have happened. The belief then begins anew where it has to."""
        motion, position, anchor = self.motion, self.position, self.motion.anchor
        clear = position.clear(motion.places, percept.world_from_camera, percept.intrinsics_px, wholly_hiding(others))
        evidence = of_whole(percept, self.kind.radius_m, others) if seen else None
        change = motion.step(percept.step, evidence, percept.presence, clear)
        if change is None:
            return None
        if change.kind == "gone":
            position.lost(rng)
        elif change.kind != "rests":
            position.placed(change.place, change.covariance, rng)
            self.since = percept.step
        if change.kind == "moved" and anchor is not None and not position.clear(
                anchor.place[None], percept.world_from_camera, percept.intrinsics_px, wholly_hiding(others))[0]:
            self.left = anchor.place, anchor.covariance[:3, :3]
        if change.kind == "moved" and self.goal_view is not None:
            self.goal_view.forget()
        return change

    def _free_energy(self, percept: Percept, prior: float, before: Moments, after: Moments, seen: bool) -> Energy:
        """The terms of F at this step. An object that is not seen has only the identity and the position term.

        `prior` is the probability that the object was expected in this view. `before` and `after` are the moments of
        its position before and after the image.
        """
        terms: Energy = {"f_identity": identity_term(percept.presence, prior),
                         "f_position": position_term(before, after)}
        if not seen:
            return terms
        last, self.last_seen = self.last_seen, percept
        terms |= {"f_crop": crop_term(percept, before), "f_likelihood": likelihood_term(percept)}
        if len(percept.latent_mean) and self.kind.transition is not None:
            terms["f_pose"] = pose_term(percept, last, after[0], self.kind.transition)
        return terms


class ToldViews(TypedDict, total=False):
    """The fields of `Belief` about how the goal's camera was turned."""

    goal_rotations: NDArray[np.float64]
    goal_rotations_log_probability: NDArray[np.float64]


def _told(views: Views | None) -> ToldViews:
    if views is None:
        return {}
    return {"goal_rotations": views.rotations, "goal_rotations_log_probability": views.log_probability}
