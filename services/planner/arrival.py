"""Whether the view at which the camera has arrived is the goal's, and where the agent looks next if it is not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saccade.services.planner.declaring import FROM_ABOVE, UNLIKELY, Evidence, around, fused_here
from saccade.services.planner.hand import Hand
from saccade.services.planner.instances import Tried
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import Array, unit
from saccade.shared.world.symmetry import NONE

THERE_M = 0.04  # chosen: a view that was compared is the goal's if the goal's is believed to be within this of it
SAID = 3  # chosen: steps for which the agent says that it is there before it takes the episode's going on for a no
PATIENT = 6  # chosen: arrivals at views that agree in part after which one of them counts as wrong
SURE_ALONE = 0.6  # chosen: without second thoughts the agent says so above this probability by the present view


class Arrival:
    """Judges the views at which the camera arrives in one episode. What it finds out is kept in `Tried`.

    Without `retry` there are no second thoughts: the present view alone decides. `moved_by` says who moves the camera,
    and `ends_at_goal` whether the world ends the episode at the goal.
    """

    def __init__(self, symmetry: Mapping[str, int], *, retry: bool, moved_by: str, ends_at_goal: bool):
        self._symmetry, self._retry, self._ends_at_goal = symmetry, retry, ends_at_goal
        self._follows = moved_by != "recording"  # whether the camera follows the plan
        self._compared = False  # whether a view of the target was compared with the goal image

    def see(self, target: Belief, tried: Tried) -> None:
        """Keeps in mind which directions are likely now, and whether views are compared. Views that look the same are
        no rivals."""
        self._compared |= target.goal_agreement is not None
        if self._retry and self._symmetry[target.object] == NONE:
            tried.rivals.take(target)

    def judge(self, target: Belief, camera: Array, tried: Tried, eye: Array | None) -> bool:
        """Whether the agent says that the goal's view is here, at the pose of the camera [4, 4]. If not, `tried` says
        where it looks next. `eye` [3] is where the goal's view is believed to be."""
        if not self._retry:
            return target.goal_here > SURE_ALONE
        if tried.beside:
            tried.wanted = tried.beside.pop(0)
            return False
        evidence = self._evidence(target, camera, tried)
        tried.is_near = evidence.is_enough
        if evidence.is_enough:
            tried.wanted = None
        declared = evidence.is_enough and self._is_at(eye, camera, evidence)
        if declared and self._was_wrong(tried):
            declared = tried.is_near = False
            self._look_elsewhere(target, camera, tried, evidence.look)
        elif not tried.is_near:
            self._has_looked(target, camera, tried, evidence.look, wrong=not _may_be_beside(evidence, tried) and (
                not evidence.rival or evidence.probability < UNLIKELY))
        return declared

    def judge_hand(self, hand: Hand, target: Belief | None, camera: Array, tried: Tried,
                   eye: Array | None) -> tuple[bool, bool]:
        """Whether the plan of a hand is to be renewed, and whether the agent says that the goal's view is here. The
        target is None while the agent searches."""
        evidence = None if target is None else self._evidence(target, camera, tried)
        eye = eye if tried.wanted is None else None  # whoever looks from elsewhere is not led back before
        verdict = hand.take(camera, evidence, eye)
        if verdict in ("wrong", "rival") and target is not None:
            self._has_looked(target, camera, tried, hand.look, wrong=verdict == "wrong")
        return verdict in ("renew", "wrong", "rival"), verdict == "there"

    def _evidence(self, target: Belief, camera: Array, tried: Tried) -> Evidence:
        fused = fused_here(target, camera, self._symmetry[target.object])
        above = float(unit(camera[:3, 3] - target.mean_m)[2]) > FROM_ABOVE
        return Evidence(target.goal_here, fused, tried.rivals.beside(camera, target.mean_m) is not None,
                        tried.rivals.elsewhere(camera, target.mean_m), target.goal_agreement, self._compared, above)

    def _is_at(self, eye: Array | None, camera: Array, evidence: Evidence) -> bool:
        """Whether the camera is where the goal's view is believed to be, now that it was compared. Where nobody follows
        the plan, the task's tolerance was enough to arrive."""
        if eye is None or evidence.agreement is None or not self._follows:
            return True
        return bool(np.linalg.norm(eye - camera[:3, 3]) < THERE_M)

    def _was_wrong(self, tried: Tried) -> bool:
        """Whether the agent has said often enough that it is there: where the world ends an episode at the goal, one
        that goes on is not there."""
        tried.said += 1
        return self._ends_at_goal and tried.said % SAID == 0

    def _look_elsewhere(self, target: Belief, camera: Array, tried: Tried, look: float) -> None:
        """Looks from all around a view that was like the goal's and was not it, once, and then from elsewhere. Where it
        agrees best is believed to be the goal's view."""
        if tried.beside is None and look > UNLIKELY:
            tried.beside = [*around(unit(camera[:3, 3] - target.mean_m)), None]
            tried.wanted = tried.beside.pop(0)
        else:
            self._has_looked(target, camera, tried, look, wrong=True)

    def _has_looked(self, target: Belief, camera: Array, tried: Tried, look: float, *, wrong: bool) -> None:
        """The agent has arrived and looked, and goes on: to a rival, if the view may be the goal's all the same."""
        tried.rivals.looked(camera, target.mean_m, look)
        tried.wanted = None if wrong else tried.rivals.beside(camera, target.mean_m)
        if wrong and self._retry:
            tried.visited.append(camera)


def _may_be_beside(evidence: Evidence, tried: Tried) -> bool:
    """Whether the goal's view may be beside one that agrees in part. Where the agent comes no nearer, it is not."""
    tried.in_part = (tried.in_part + 1) % PATIENT if evidence.is_beside else 0
    return tried.in_part > 0
