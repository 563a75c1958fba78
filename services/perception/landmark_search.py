"""Looks for the landmarks of all objects in all things, in any roll: for photographs, where nothing says what stands.

The agent does not do this: the camera's pose says what is up, and one image after the other shows the same things.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from saccade.services.perception.landmark_fit import FEATURES, Fit, LandmarkFit
from saccade.services.perception.likeness import SURE
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.things import FINE_PX, Things, rolled

ELECTED = 24  # pairs of a roll and an object whose landmarks are fitted to a thing
CLEAR = 60  # landmarks; where so many fit, nothing else is tried


@dataclass(frozen=True)
class Found:
    """The object whose landmarks fit a thing best: its number, how they fit, and the angle (rad) by which the crop was
    rolled."""

    object: int
    fit: Fit
    roll: float


class LandmarkSearch:
    """Searches for K objects."""

    def __init__(self, features: LocalFeatures, fits: Sequence[LandmarkFit]):
        self.features, self.fits = features, fits

    def __call__(self, things: Things, rolls: Sequence[float]) -> dict[int, Found]:
        """What was found for sure, by the number of the thing."""
        best = {thing: self._best(things, thing, rolls) for thing in range(len(things.fine))}
        return {thing: found for thing, found in best.items() if found is not None and found.fit.support >= SURE}

    def _best(self, things: Things, thing: int, rolls: Sequence[float]) -> Found | None:
        """What fits a thing best. In which rolls which objects are fitted, is elected by votes."""
        turned = rolled(things.fine[thing, None].expand(len(rolls), -1, -1, -1), torch.tensor(rolls))
        seen = self.features(turned, FEATURES)
        focal = FINE_PX / 2 / float(things.window.half_tangent[thing])
        votes = torch.tensor([[fit.votes(each) for fit in self.fits] for each in seen]).flatten()
        best: Found | None = None
        for elected in votes.topk(min(ELECTED, len(votes))).indices.tolist():
            roll, k = divmod(elected, len(self.fits))
            fit = self.fits[k](seen[roll], focal, FINE_PX)
            if fit is not None and (best is None or fit.inliers > best.fit.inliers):
                best = Found(k, fit, rolls[roll])
                if fit.inliers >= CLEAR:
                    break
        return best
