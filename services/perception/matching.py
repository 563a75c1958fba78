"""Which thing of an image is which object. Of several of a kind the likeliest comes first; what no object was found in
may be one more of an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from saccade.services.perception.landmark_fit import Fit
from saccade.services.perception.seen import MOST
from saccade.services.perception.things import Match

SURELY = 0.9  # the presence that counts as sure
FOUND = 0.5  # chosen: presence from which on an object counts as found in a thing
LESS = 0.15  # chosen: of a similarity; one more of an object is not less like it by more than this


def best_matches(pairs: Sequence[tuple[int, int, int]], log_odds: NDArray[np.float64],
                 fits: Mapping[tuple[int, int], Fit]) -> dict[int, Match]:
    """Where each object is likeliest, of those in the pairs (object, thing, view). A thing is one object, or none of
    them: `log_odds` are those against none. Where an object is sure to be in several things, as in the whole image and
    in a part of it, landmarks decide."""
    odds = np.exp(np.clip(log_odds, -30, 30))
    best = _likeliest_views(pairs, odds)
    total: dict[int, float] = {}
    for (_, thing), row in best.items():
        total[thing] = total.get(thing, 1.0) + float(odds[row])
    matches = {}
    for k in sorted({k for k, _ in best}):
        seen = [(float(odds[r]) / total[t], t, r) for (o, t), r in best.items() if o == k]
        support = {t: fits[k, t].support if (k, t) in fits else 0.0 for _, t, _ in seen}
        presence, thing, row = max(seen, key=lambda each: (min(each[0], SURELY), support[each[1]], each[0]))
        matches[k] = Match(thing, presence, pairs[row][2], row, fits.get((k, thing)))
    return matches


def _likeliest_views(pairs: Sequence[tuple[int, int, int]], odds: NDArray[np.float64]) -> dict[tuple[int, int], int]:
    """The row of the likeliest view of each object in each thing."""
    best: dict[tuple[int, int], int] = {}
    for row, (k, thing, _) in enumerate(pairs):
        if (k, thing) not in best or odds[row] > odds[best[k, thing]]:
            best[k, thing] = row
    return best


def unclaimed(like: NDArray[np.float64], matches: Mapping[int, Match], *, whole: bool) -> list[tuple[int, int]]:
    """The things in which no object was found and what they may be: (object, thing). By its likeness to the objects
    [K, P] a thing is nearly as like an object that was found as what it was found in. The last thing may be the `whole`
    image."""
    taken = {match.thing for match in matches.values() if match.presence >= FOUND}
    pairs = []
    for thing in sorted(set(range(like.shape[1] - whole)) - taken):
        mine = [k for k, match in matches.items() if match.presence >= FOUND
                and like[k, thing] > like[k, match.thing] - LESS]
        pairs += [(k, thing) for k in mine]
    return pairs


def further_matches(pairs: Sequence[tuple[int, int, int]], odds: NDArray[np.float64],
                    fits: Mapping[tuple[int, int], Fit]) -> list[tuple[int, Match]]:
    """The objects and where there is one more of each, the likeliest first, by the odds of pairs (object, thing, view)
    against none."""
    found: list[tuple[int, Match]] = []
    views = _likeliest_views(pairs, odds)
    for thing in sorted({thing for _, thing in views}):
        best = {k: row for (k, where), row in views.items() if where == thing}
        k = max(best, key=lambda each: odds[best[each]])
        presence = float(odds[best[k]] / (1.0 + sum(odds[row] for row in best.values())))
        if presence >= FOUND:
            found.append((k, Match(thing, presence, pairs[best[k]][2], best[k], fits.get((k, thing)))))
    found.sort(key=lambda each: -each[1].presence)
    return [each for n, each in enumerate(found) if sum(k == each[0] for k, _ in found[:n]) < MOST - 1]
