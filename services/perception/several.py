"""Several of a kind in one image: the votes of the extraction network, sorted by the object that they point to.

Each cell that sees an object votes for its centre. The votes of two objects of a kind point to two places. Where they
point to one place, nothing is changed: the object is there once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from saccade.services.perception.networks import CELLS
from saccade.services.perception.seen import MOST

VOTER = 0.3  # chosen: probability above which a cell that sees the object votes
NEAR = 0.7  # chosen: votes belong to one object if they point to within this share of its radius
FEWEST = 4.0  # chosen: cells that speak for an object where there are several
AGAINST = -30.0  # logit of a cell that votes for another one


@dataclass(frozen=True)
class Group:
    """One of several of a kind: the logits of its own votes [30, 30], and whether what is seen at a cell of a finer
    grid belongs to it [60, 60]."""

    vote_logits: Tensor
    own: Tensor


def groups(vote_logits: Tensor, votes: Tensor, radius: float, side: int) -> list[Group]:
    """Sorts the votes for one kind: logits [30, 30] and votes [3, 30, 30], as `tally` takes them.

    `radius` is the object's radius, in image widths, at the scale 1. `side` is that of the finer grid. Returns the
    objects, the one with the most votes first; nothing if there are not several.
    """
    place = (torch.arange(CELLS, dtype=votes.dtype) + 0.5) / CELLS
    share = vote_logits.flatten().sigmoid()
    voters = torch.nonzero(share > VOTER)[:, 0]
    if len(voters) < 2 * FEWEST:
        return []
    at = torch.stack([place.expand(CELLS, -1).flatten(), place[:, None].expand(-1, CELLS).flatten()], -1)[voters]
    aimed = at + votes[:2].flatten(1)[:, voters].T
    reach = (NEAR * radius * votes[2].flatten()[voters].exp()).clamp(min=1.0 / CELLS)
    which = _sorted(aimed, share[voters], reach)
    numbers = [n for n in range(MOST) if float(share[voters][which == n].sum()) >= FEWEST]
    if len(numbers) < 2:
        return []
    fine = (torch.arange(side, dtype=votes.dtype) + 0.5) / side
    pixels = torch.stack([fine.expand(side, -1).flatten(), fine[:, None].expand(-1, side).flatten()], -1)
    apart = torch.stack([torch.cdist(pixels, at[which == n]).min(1).values for n in numbers])
    nearest = apart.argmin(0).view(side, side)
    result = []
    for row, n in enumerate(numbers):
        theirs = torch.zeros(CELLS * CELLS, dtype=torch.bool)
        theirs[voters[which != n]] = True
        logits = vote_logits.masked_fill(theirs.view(CELLS, CELLS), AGAINST)
        result.append(Group(logits, nearest == row))
    return result


def _sorted(aimed: Tensor, weight: Tensor, reach: Tensor) -> Tensor:
    """The number of the object to which each of N votes belongs [N], or MOST. The votes point to places [N, 2], count
    `weight` [N], and belong to what is within `reach` [N]."""
    which = torch.full((len(aimed),), MOST)
    near = torch.cdist(aimed, aimed) < reach
    for number in range(MOST):
        left = weight * (which == MOST)
        if float(left.sum()) < FEWEST:
            break
        center = aimed[int((near * left).sum(1).argmax())]
        for _ in range(3):  # mean shift
            mine = left * (torch.linalg.vector_norm(aimed - center, dim=1) < reach)
            if float(mine.sum()) == 0.0:
                break
            center = (aimed * mine[:, None]).sum(0) / mine.sum()
        which[mine > 0] = number
    return which
