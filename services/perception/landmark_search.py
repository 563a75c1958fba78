"""Looks for the landmarks of all objects in all things, in any roll: for photographs, where nothing says what stands.

The agent does not do this: the camera's pose says what is up, and one image after the other shows the same things.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from saccade.services.perception.landmark_fit import FEATURES, LandmarkFit
from saccade.services.perception.likeness import SURE
from saccade.services.perception.local_features import Features, LocalFeatures
from saccade.services.perception.things import FINE_PX, Things, rolled

VOTERS = 250  # features of a crop that vote for an object
ELECTED = 8  # objects whose landmarks are fitted to a crop


@dataclass(frozen=True)
class Found:
    """The object whose landmarks fit a thing best: its number, how many fit, and the angle (rad) by which the crop was
    rolled."""

    object: int
    inliers: int
    roll: float


class LandmarkSearch:
    """Searches for K objects."""

    def __init__(self, features: LocalFeatures, fits: Sequence[LandmarkFit]):
        self.features, self.fits = features, fits

    def __call__(self, things: Things, rolls: Sequence[float]) -> dict[int, Found]:
        """What was found for sure, by the number of the thing."""
        best: dict[int, Found] = {}
        for roll in rolls:
            angle = torch.full((len(things.fine),), roll)
            fine = rolled(things.fine, angle) if roll else things.fine
            for thing, seen in enumerate(self.features(fine, FEATURES)):
                focal = FINE_PX / 2 / float(things.window.half_tangent[thing])
                for k in self._elected(seen):
                    fit = self.fits[k](seen, focal, FINE_PX)
                    if fit is not None and (thing not in best or fit.inliers > best[thing].inliers):
                        best[thing] = Found(k, fit.inliers, roll)
        return {thing: found for thing, found in best.items() if found.inliers >= SURE}

    def _elected(self, seen: Features) -> list[int]:
        """The objects of which most landmarks may be seen from one side."""
        if len(self.fits) <= ELECTED:
            return list(range(len(self.fits)))
        votes = torch.tensor([fit.votes(seen, VOTERS) for fit in self.fits])
        return votes.topk(ELECTED).indices.tolist()
