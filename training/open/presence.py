"""Fits how likely a thing is an object, from how alike they are, on rendered tables that nothing was trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.comparer import Compared
from saccade.services.perception.likeness import OBJECTS, LogOdds, log_odds
from saccade.services.perception.open_world import OpenWorld
from saccade.shared.model.bank import FILLED, Bank
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.training.open.proposer import circles_px
from saccade.training.open.table_crops import Sights
from saccade.training.open.tables import Tables

NEAR, FAR = 0.4, 1.0  # of a circle's radius: a proposal within the first shows it, one between them is not counted
UP = (0.0, 1.0, 0.0)
RIDGE, MISTAKEN, UNLIKELY = 0.1, 0.01, -30.0


@dataclass(frozen=True)
class Evidence:
    """What speaks for each of K objects in a thing [K]: the similarity, the logit of the comparison, how many landmarks
    fit, and how many usually do. Objects that may be in the crop beside the thing are `beside` [K]. `shown` is the
    number of the object that it shows, K if it is none of them."""

    similar: Tensor
    same: Tensor
    found: Tensor
    usual: Tensor
    beside: Tensor
    shown: int


def fit_presence(model: OpenWorld, banks: Mapping[int, Bank], tables: Tables, sights: Sights,
                 rng: np.random.Generator) -> LogOdds:
    """The likeliest coefficients of the log odds. `banks` are those of objects by their numbers in `sights`."""
    intrinsics = np.array(INTRINSICS_PX) * tables.rgb.shape[1] / IMAGE_SIZE_PX
    circles, evidence = circles_px(sights, intrinsics), list[Evidence]()
    for table in range(len(tables.rgb)):
        here = np.flatnonzero(sights.table == table)
        chosen = _drawn(np.array(sorted(banks)), sights.object[here], rng)
        some = OpenWorld(model.proposer, model.encoder, model.comparison, model.features, [banks[n] for n in chosen],
                         model.cohort, model.log_odds)
        evidence += _evidence(some, tables.rgb[table], intrinsics, circles[here], sights.object[here], chosen)
    return fitted(evidence)


def _drawn(known: NDArray[np.int64], there: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """A set of objects, in which about half of those that are there are. All other things there are strangers."""
    mine = rng.permutation(there)[:max(1, min(len(there) // 2, OBJECTS - 1))]
    others = rng.permutation(known[~np.isin(known, there)])
    return np.concatenate([mine, others])[:OBJECTS]


@torch.inference_mode()
def _evidence(model: OpenWorld, rgb: NDArray[np.uint8], intrinsics_px: NDArray[np.float64],
              circles: NDArray[np.float64], objects: NDArray[np.int64], chosen: NDArray[np.int64]) -> list[Evidence]:
    """The evidence in an image, for each thing of which it can be said what it shows. The objects that are there are
    `objects`, with their `circles`; those of the model are `chosen`."""
    told = list[Evidence]()
    things = model.things(rgb, intrinsics_px, UP)
    if not len(things.crops):
        return told
    things, similar = model.rolled_things(things)
    count = len(chosen)
    for n in range(len(things.crops)):
        radius = float(things.window.half_tangent[n]) * FILLED * intrinsics_px[0]
        away = np.linalg.norm(circles[:, :2] - things.window.pixels[n], axis=1)
        off = np.maximum(away / circles[:, 2], np.abs(np.log(radius / circles[:, 2])))
        nearest = int(off.argmin()) if len(off) else -1
        if nearest >= 0 and NEAR < off[nearest] <= FAR:
            continue
        shown = objects[nearest] if nearest >= 0 and off[nearest] <= NEAR else -1
        others = objects[(away < radius + circles[:, 2]) & (objects != shown)]
        view = [int(each[n].argmax()) for each in similar]
        known = torch.stack([model.view(k, v) for k, v in enumerate(view)])
        same = Compared(model.comparison(things.crops[n].expand(count, -1, -1, -1), known)).same
        fits = model.fitted(things, [(k, n) for k in range(count)])
        found, usual = model.found([(k, n, 0) for k in range(count)], fits)
        told.append(Evidence(torch.stack([each[n].max() for each in similar]), same, found, usual,
                             torch.from_numpy(np.isin(chosen, others)),
                             int(np.argmax(chosen == shown)) if shown in chosen else count))
    return told


def fitted(evidence: Sequence[Evidence]) -> LogOdds:
    """The coefficients that make what the things show likeliest, up to a small share that may be labelled wrongly."""
    similar, same, found, usual, beside = (torch.stack([getattr(each, name) for each in evidence]).double()
                                           for name in ("similar", "same", "found", "usual", "beside"))
    shown = torch.tensor([each.shown for each in evidence])
    free = torch.tensor(astuple(LogOdds()), dtype=torch.float64, requires_grad=True)
    first = free.detach().clone()
    optimizer = torch.optim.LBFGS([free], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        mine = log_odds(free, similar, same, found, usual)
        odds = torch.cat([mine.masked_fill(beside > 0, UNLIKELY), torch.zeros(len(mine), 1, dtype=torch.float64)], 1)
        right = odds.softmax(1)[torch.arange(len(shown)), shown]
        value = -((1 - MISTAKEN) * right + MISTAKEN / odds.shape[1]).log().mean()
        value = value + RIDGE * (((free - first) / first) ** 2).sum() / len(shown)
        value.backward()
        return value

    optimizer.step(loss)
    return LogOdds(*free.detach().clamp(min=1e-3).tolist())
