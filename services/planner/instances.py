"""Which one of the target's kind the planner goes for: any of them fits the goal image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from saccade.services.planner.declaring import Rivals
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import Array

SURER = 1.0  # chosen: nats by which another instance must be better than the one that the agent goes for
FOUND_M = 0.06  # chosen: an instance is a choice if the deviation of its position is below this
PER_M = 3.0  # chosen: nats for each metre of the way to an instance's view of the goal
WRONG = 1.5  # chosen: nats for each of its views that was not the goal's
BLOCKED = 6.0  # chosen: nats for a view that the camera cannot come near to


@dataclass
class Tried:
    """What the agent has found out about the goal's view at one instance."""

    since: int = 0  # the step since which the instance is as it is
    rivals: Rivals = field(default_factory=Rivals)
    wanted: Array | None = None  # the rival direction [3] from which the agent is about to look
    is_near: bool = False  # the goal's view is sure to be near, and the agent goes to where it is believed to be
    said: int = 0  # steps in which the agent has said that it is there
    beside: list[Array | None] | None = None  # directions [3] around such a view from which it will look; then back
    in_part: int = 0  # arrivals since the last that was given up at views that agree in part
    visited: list[Array] = field(default_factory=list)  # camera poses [4, 4] at which it arrived in the mode "goal"


def flat(beliefs: Mapping[str, Belief], target: str | None, number: int) -> dict[str, Belief]:
    """One belief under each name, and the further ones of each kind under their labels. Under the target's name it is
    the one of this number, if there is one. Who has a target does not look for further ones that were not found."""
    result = dict(beliefs)
    for name, belief in beliefs.items():
        each = belief.each()
        first = next((b for b in each if name == target and b.instance == number), belief)
        result[name] = first
        result |= {f"{name}#{b.instance}": b for b in each if b is not first and (target is None or _is_found(b))}
    return result


def _is_found(belief: Belief) -> bool:
    return bool(np.trace(belief.covariance_m2) < FOUND_M ** 2)


def score(belief: Belief, eye: Array | None, camera: Array, tried: Tried | None, *, is_blocked: bool) -> float:
    """How good it is to go for an instance, in nats: that it is there, how sure it is from where it looks like the goal
    image, and how near the view is, at the position `eye` [3] if it is known, to a camera [4, 4]."""
    if not _is_found(belief) or eye is None or belief.goal_log_posterior is None:
        return -np.inf
    sure = float(belief.goal_log_posterior.max())
    way_m = float(np.linalg.norm(eye - camera[:3, 3]))
    wrong = 0 if tried is None else len(tried.visited)
    return float(np.log(max(belief.presence, 1e-6))) + sure - PER_M * way_m - WRONG * wrong - BLOCKED * is_blocked


def best_of(scores: Mapping[int, float], number: int) -> int:
    """The number of the best instance. The one that the agent goes for, `number`, is kept unless another is clearly
    better, or it is not there any more."""
    best = max(sorted(scores), key=lambda n: scores[n])
    stays = number in scores and not scores[best] > scores[number] + SURER
    return number if stays else best
