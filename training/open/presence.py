"""Fits how likely a thing is an object, from how alike they are, on rendered tables that nothing was trained on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.comparer import Compared
from saccade.services.perception.likeness import LogOdds
from saccade.services.perception.open_world import OpenWorld
from saccade.shared.model.bank import FILLED, Bank
from saccade.training.open.proposer import circles_px
from saccade.training.open.table_crops import INTRINSICS, TableCrops

OBJECTS = 5  # in a set that is drawn for a table; all other things there are strangers
NEAR, FAR = 0.4, 1.0  # of a circle's radius: a proposal within the first shows it, one between them is not counted
UP = (0.0, 1.0, 0.0)
RIDGE = 1e-3


def fit_presence(model: OpenWorld, banks: Mapping[int, Bank], tables: TableCrops, rng: np.random.Generator) -> LogOdds:
    """The likeliest coefficients of the log odds. `banks` are those of objects by their numbers in `tables`."""
    alike, same, label = [], [], []
    circles = circles_px(tables)
    for table in range(len(tables.rgb)):
        here = np.flatnonzero(tables.sights.table == table)
        chosen = _drawn(np.array(sorted(banks)), tables.sights.object[here], rng)
        some = OpenWorld(model.proposer, model.encoder, model.comparison, [banks[n] for n in chosen], model.cohort,
                         model.log_odds)
        for thing in _likeness(some, tables.rgb[table].cpu().numpy(), circles[here], tables.sights.object[here]):
            if thing is not None:
                alike.append(thing[0])
                same.append(thing[1])
                label.append(int(np.argmax(chosen == thing[2])) if thing[2] in chosen else OBJECTS)
    return fitted(torch.stack(alike), torch.stack(same), torch.tensor(label))


def _drawn(known: NDArray[np.int64], there: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """A set of objects, in which about half of those that are there are."""
    mine = rng.permutation(there)[:max(1, min(len(there) // 2, OBJECTS - 1))]
    others = rng.permutation(known[~np.isin(known, there)])
    return np.concatenate([mine, others])[:OBJECTS]


@torch.inference_mode()
def _likeness(model: OpenWorld, rgb: NDArray[np.uint8], circles: NDArray[np.float64],
              objects: NDArray[np.int64]) -> list[tuple[Tensor, Tensor, int] | None]:
    """For each thing in an image its similarities to the objects of the model [K], the logits of the comparisons [K],
    and which object it shows (-1: none that is known); None where that cannot be said."""
    told: list[tuple[Tensor, Tensor, int] | None] = []
    things = model.things(rgb, INTRINSICS, UP)
    if not len(things.crops):
        return told
    things, similar = model.rolled_things(things)
    for n in range(len(things.crops)):
        view = [int(each[n].argmax()) for each in similar]
        known = torch.stack([model.view(k, v) for k, v in enumerate(view)])
        same = Compared(model.comparison(things.crops[n].expand(len(known), -1, -1, -1), known)).same
        radius = float(things.window.half_tangent[n]) * FILLED * INTRINSICS[0]
        off = np.linalg.norm(circles[:, :2] - things.window.pixels[n], axis=1) / circles[:, 2]
        off = np.maximum(off, np.abs(np.log(radius / circles[:, 2])))
        nearest = int(off.argmin()) if len(off) else -1
        if nearest < 0 or off[nearest] > FAR:
            shown = -1
        elif off[nearest] > NEAR:
            told.append(None)
            continue
        else:
            shown = int(objects[nearest])
        told.append((torch.stack([each[n].max() for each in similar]), same, shown))
    return told


def fitted(alike: Tensor, same: Tensor, label: Tensor) -> LogOdds:
    """The coefficients that make these labels [T] (from 0 to K; K: none of the objects) likeliest, where things have
    these similarities and logits [T, K]."""
    free = torch.tensor([20.0, 0.5, 3.0], dtype=torch.float64, requires_grad=True)
    start = free.detach().clone()
    optimizer = torch.optim.LBFGS([free], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        mine = free[0] * alike.double() + free[1] * same.double() - free[2]
        odds = torch.cat([mine, torch.zeros(len(mine), 1, dtype=torch.float64)], 1)
        value = F.cross_entropy(odds, label) + RIDGE * ((free - start) ** 2).sum() / len(label)
        value.backward()
        return value

    optimizer.step(loss)
    similar, compared, none = free.detach().clamp(min=1e-3).tolist()
    return LogOdds(similar, compared, none)
