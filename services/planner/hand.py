"""A camera in a hand: a person needs many images for a move, sways, and may go elsewhere."""

from __future__ import annotations

from collections import deque
from typing import Literal

import numpy as np

from saccade.services.planner.declaring import UNLIKELY, Evidence
from saccade.shared.world.geometry import Array, pose, rotation_angle
from saccade.shared.world.guidance import NEAR_M, NEAR_RAD
from saccade.shared.world.task import Spheres, clip, success

Verdict = Literal["stay", "renew", "wrong", "rival", "there"]

LOOKS, MOST_LOOKS = 5, 15  # chosen: at least and at most so many images decide whether a view is the goal's
PATIENCE = 20  # chosen: after so many images within the task's tolerance a hand will not come nearer
ELSEWHERE_M = 0.15  # chosen: a hand goes elsewhere if it is so much farther from the viewpoint than it has been
MOVED_M = 0.03  # chosen: a plan is renewed if the believed view of the goal moves by more than this
# Chosen: within this of where the goal's view is believed to be, images that agree so well in the mean are the goal's.
ALIKE_M, ALIKE_HERE = 0.05, 0.45
SHIFTED_M = 0.015  # chosen: the same before it is decided whether the view is the goal's


class Hand:
    """Follows how a hand comes to one viewpoint after the other.

    The plan stays until the viewpoint is reached, the hand goes elsewhere, or the goal's view is believed to be
    elsewhere; for the last, a plan has to be `renewed_after` images old. Once the agent has said that it is `there`,
    the plan stays for good.
    """

    def __init__(self, renewed_after: int) -> None:
        self._renewed_after, self.there = renewed_after, False
        self._lately: deque[float] = deque(maxlen=LOOKS)  # how well the last images agree with the goal image

    def follow(self, viewpoint: Array, spheres: Spheres, eye: Array | None) -> Array:
        """Begins with a new viewpoint [4, 4]. Returns it, at a position to which a hand can come. `eye` [3] is where
        the goal's view is believed to be."""
        self.viewpoint, self._eye = pose(viewpoint[:3, :3], clip(viewpoint[:3, 3], spheres)), eye
        self._nearest_m, self._age = np.inf, 0
        self._looks: list[float] = []
        self._agreements: list[float] = []
        return self.viewpoint

    def take(self, camera: Array, evidence: Evidence | None, eye: Array | None) -> Verdict:
        """Takes the camera's pose [4, 4] in an image.

        A viewpoint from which to search is reached within the task's tolerance. At one that may be the goal's,
        `evidence` speaks for it, by this image and by all. There the camera must be nearer, unless it has not come
        nearer for a while, and the mean of several images decides. The verdict `rival` asks for a look from another
        direction before. Where the last images agree well with the goal image, the camera is there, although the goal's
        view is believed to be a bit aside; then this is the viewpoint.
        """
        self._age += 1
        if self.there:
            return "there" if success(camera, self.viewpoint) else "stay"
        if self._is_here(camera, evidence, eye):
            self.viewpoint, self.there = camera, True
            return "there"
        if evidence is not None and self._age >= self._renewed_after and self._has_moved(eye, MOVED_M):
            return "renew"
        away_m = float(np.linalg.norm(camera[:3, 3] - self.viewpoint[:3, 3]))
        self._nearest_m = min(self._nearest_m, away_m)
        if not success(camera, self.viewpoint):
            self._looks.clear()
            self._agreements.clear()
            return "renew" if away_m > self._nearest_m + ELSEWHERE_M else "stay"
        if evidence is None:
            return "renew"
        self._looks.append(evidence.look)
        if evidence.agreement is not None:
            self._agreements.append(evidence.agreement)
        near = away_m < NEAR_M and rotation_angle(camera[:3, :3], self.viewpoint[:3, :3]) < NEAR_RAD
        if len(self._looks) < (LOOKS if near else PATIENCE):
            return "stay"
        if self._has_moved(eye, SHIFTED_M):
            return "renew"
        return self._judge(evidence)

    def _is_here(self, camera: Array, evidence: Evidence | None, eye: Array | None) -> bool:
        self._lately.append(0.0 if evidence is None or evidence.agreement is None else evidence.agreement)
        if evidence is None or evidence.agreement is None or eye is None or not evidence.is_enough:
            return False
        return bool(np.linalg.norm(camera[:3, 3] - eye) < ALIKE_M) and sum(self._lately) > LOOKS * ALIKE_HERE

    def _judge(self, evidence: Evidence) -> Verdict:
        """Whether the view is the goal's, by the looks at it so far; `stay` asks for more of them."""
        evidence = evidence._replace(look=self.look, agreement=_recent(self._agreements))
        self.there = evidence.is_enough
        if self.there:
            return "there"
        if evidence.rival and evidence.probability >= UNLIKELY:
            return "rival"
        return "wrong" if evidence.probability < UNLIKELY or len(self._looks) >= MOST_LOOKS else "stay"

    @property
    def look(self) -> float:
        """The mean of the looks at the viewpoint so far. 0 before the first."""
        return _recent(self._looks) or 0.0

    def _has_moved(self, eye: Array | None, by_m: float) -> bool:
        if eye is None or self._eye is None:
            return False
        return bool(np.linalg.norm(eye - self._eye) > by_m)


def _recent(values: list[float]) -> float | None:
    """The mean of the last values. None if there are none."""
    return float(np.mean(values[-MOST_LOOKS:])) if values else None
