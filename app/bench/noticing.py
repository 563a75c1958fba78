"""Whether an agent noticed what happened: the events that it reported against the truth.

A change counts from the first image in which it can be seen: the object is in view where it is now, or the place is in
view from which it was taken. What was changed back before any image showed it is no change. All functions are pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Events, Truth
from saccade.shared.world.sight import IN_VIEW, seen_shares
from saccade.shared.world.workspace import NO_BOXES, Boxes

WITHIN = 5  # a change is noticed if it is reported at most so many images after the first that shows it
AGAIN = 5  # steps after a report, and after the first image of a change, in which reports are of the same change


class Noticed(NamedTuple):
    """Of one episode: how many changes could be noticed, how many were in time, and how many reports were of nothing.
    A change that was not reported when the episode ended counts only if it was in view long enough."""

    changes: int
    noticed: int
    false_events: int


@dataclass
class _Pose:
    """Where an object is, and how many times it has begun to change. Without a box it is not there."""

    name: str
    box: Boxes | None
    changes: int = 0
    moving: bool = False  # it changed with this very step


@dataclass
class _Watched:
    """What an observer who misses nothing knows of one object."""

    now: _Pose
    seen: _Pose | None = None  # as it was when it, or its place, was in view last
    place: Boxes | None = None  # where it was when it was in view last
    images: int | None = None  # since the change that is to be noticed came into view
    open: bool = False  # there is a change that a report may be of
    reported: int | None = None  # the step of the first report of it


@dataclass
class _Tally:
    changes: int = 0
    noticed: int = 0
    false_events: int = 0
    watched: dict[str, _Watched] = field(default_factory=dict)


def noticed(truths: Sequence[Truth], reports: Iterable[Events]) -> Noticed:
    """Compares the events that an agent reported in an episode with its truths, which are in the order of the steps."""
    told = {report.step: set(report.objects) for report in reports}
    tally = _Tally()
    for truth in truths:
        boxes = _boxes(truth)
        names = dict(zip(truth.labels(), truth.names, strict=True))
        for label in names.keys() - tally.watched.keys():
            tally.watched[label] = _Watched(_Pose(names[label], boxes[label]))
        said = told.get(truth.step, set())
        right: set[str] = set()
        for label, each in tally.watched.items():
            _move(each, boxes.get(label))
            _look(each, truth, label, boxes)
            if _answer(each, each.now.name in said, truth.step, tally):
                right.add(each.now.name)
        tally.false_events += len(said - right)
    return Noticed(tally.changes, tally.noticed, tally.false_events)


def _boxes(truth: Truth) -> dict[str, Boxes]:
    """The box of each object. Of a scene as the paper's the sizes are not told; there nothing happens."""
    sizes = np.zeros((len(truth.names), 3)) if truth.sizes_m is None else truth.sizes_m
    turned = truth.world_from_objects()
    return {label: Boxes(truth.centers_m[k:k + 1], turned[k:k + 1], sizes[k:k + 1])
            for k, label in enumerate(truth.labels())}


def _move(each: _Watched, box: Boxes | None) -> None:
    """Takes where the object is now."""
    before = each.now
    moving = not _same(before.box, box)
    each.now = _Pose(before.name, box, before.changes + (moving and not before.moving), moving)
    if moving:
        each.open, each.reported = True, None


def _look(each: _Watched, truth: Truth, label: str, boxes: dict[str, Boxes]) -> None:
    """Takes whether the image shows the object, or that it is not where it was."""
    if not _in_view(each, truth, label, boxes):
        return
    seen, each.seen, each.place = each.seen, each.now, each.now.box or each.place
    if each.images is not None:
        each.images += 1
    elif seen is not None and seen.changes != each.now.changes and not _same(seen.box, each.now.box):
        each.images = 0
        if each.reported is not None:  # that it has left was reported; now it can be reported where it is
            each.reported = truth.step


def _in_view(each: _Watched, truth: Truth, label: str, boxes: dict[str, Boxes]) -> bool:
    if truth.done:  # there is no image of the last step
        return False
    if each.now.box is not None:
        shares: NDArray[np.float64] = np.ones(len(truth.names)) if truth.in_view is None else truth.in_view
        return bool(shares[truth.labels().index(label)] >= IN_VIEW)
    if each.place is None:
        return False
    all_boxes = [each.place, *boxes.values()]
    together = Boxes(*(np.concatenate([getattr(b, name) for b in all_boxes])
                       for name in ("centers_m", "rotations", "sizes_m")))
    return bool(seen_shares(truth.world_from_camera, together, NO_BOXES)[0] >= IN_VIEW)


def _answer(each: _Watched, said: bool, step: int, tally: _Tally) -> bool:
    """Counts the change that is to be noticed if it is decided now. Returns whether a report is of a change."""
    is_right = each.open
    if each.images is not None and (said or each.images > WITHIN):
        tally.changes += 1
        tally.noticed += said and each.images <= WITHIN
        each.images = None
    if said and each.reported is None and each.open:
        each.reported = step
    is_shown = each.seen is not None and each.seen.changes == each.now.changes
    if each.reported is not None and is_shown and step >= each.reported + AGAIN and not each.now.moving:
        each.open, each.reported = False, None
    return is_right


def _same(one: Boxes | None, other: Boxes | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one.centers_m, other.centers_m) and np.array_equal(one.rotations, other.rotations)
