"""What it is worth that a thing looks like a view of an object: how likely it is that object, or none that is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

COHORT, LIKEST = "cohort", 50  # name of the cohort's file, and how many of its views count
OBJECTS = 5  # that are known where the log odds are fitted
SURE, UNSURE = 16.0, 1.5  # landmarks
UNIT = 0.05  # about the standard deviation of the largest similarities, so that normalised ones are as large as others


@dataclass(frozen=True)
class LogOdds:
    """The log odds that a thing is an object, against its being none that is known: `similar` times the similarity to
    the object's view, `compared` times the logit of the comparison, and `landmarks` times how sure the landmarks are
    that fit, less `none`, and less `usual` times the logarithm of how many usually fit the object."""

    similar: float = 10.0
    compared: float = 0.4
    landmarks: float = 3.7
    usual: float = 0.4
    none: float = 2.0

    def __call__(self, similar: Tensor, same: Tensor, found: Tensor, usual: Tensor) -> Tensor:
        return log_odds(astuple(self), similar, same, found, usual)


def log_odds(factors: Iterable[float] | Tensor, similar: Tensor, same: Tensor, found: Tensor, usual: Tensor) -> Tensor:
    """The log odds by factors in the order of `LogOdds`."""
    by_similar, by_compared, by_landmarks, by_usual, none = factors
    return by_similar * similar + by_compared * same + by_landmarks * sure_of(found) \
        - by_usual * torch.log1p(usual) - none


def sure_of(found: Tensor) -> Tensor:
    """How sure it is (0 to 1) that a pose is right for which so many landmarks speak."""
    return torch.sigmoid((found - SURE) / UNSURE)


USUAL = LogOdds()  # until they are fitted


class Cohort:
    """Views of things that nobody knows, as unit vectors [N, D]: what a similarity is worth shows beside those to them.

    A crop that is blurred is less like everything, and a plain box is like many things. So each similarity is measured
    from the mean of the largest ones that the crop, and that the known view, have with the cohort, in units of their
    standard deviation, and the two are averaged (symmetric score normalisation, Matejka et al., Interspeech 2017).
    """

    def __init__(self, vectors: Tensor) -> None:
        self.vectors = vectors

    def likest(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation [P, 1] of the largest similarities of vectors [P, D] to the cohort."""
        largest = (vectors @ self.vectors.T).topk(min(LIKEST, len(self.vectors)), dim=1).values
        return largest.mean(1, keepdim=True), largest.std(1, keepdim=True).clamp(min=1e-3)

    def normalised(self, similar: Tensor, crops: tuple[Tensor, Tensor], views: tuple[Tensor, Tensor]) -> Tensor:
        """Similarities [P, V], normalised; `crops` [P, 1] and `views` [V, 1] are what `likest` says of both."""
        by_crop = (similar - crops[0]) / crops[1]
        by_view = (similar - views[0].T) / views[1].T
        return UNIT * (by_crop + by_view) / 2
