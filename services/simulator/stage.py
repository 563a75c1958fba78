"""What stands where during an episode, and what a camera may do there. The state is a fold over the events of the scene
and over what was in view, so that an episode that is played again is the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.services.simulator.scene import PAPER_TABLE, Drift, Event, Placed, Scene, surroundings
from saccade.shared.world.sight import IN_VIEW, seen_shares
from saccade.shared.world.task import GoalViews, Spheres, views_of_all
from saccade.shared.world.workspace import NO_BOXES, Allowed, Boxes, BoxReach, Space, boxes_of

Sizes = Mapping[str, NDArray[np.float64]]  # name -> extents [3] of the object's box, metres


def boxes_around(objects: Sequence[Placed], sizes_m: Sizes) -> Boxes:
    """The boxes of objects, as they are turned."""
    return Boxes(np.array([p.center_m for p in objects]).reshape(-1, 3),
                 np.array([p.rotation for p in objects]).reshape(-1, 3, 3),
                 np.array([sizes_m[p.name] for p in objects], dtype=np.float64).reshape(-1, 3))


class Stage:
    """The objects of a scene while its events happen. `also` is a limit of the camera that is given from outside."""

    def __init__(self, scene: Scene, sizes_m: Sizes, also: Allowed | None = None) -> None:
        self.scene, self.sizes_m, self._also = scene, sizes_m, also
        self._at = {placed.label: placed for placed in scene.on_table}
        self._away: dict[str, Placed] = {}
        self._drifting: dict[str, tuple[Drift, Placed, int]] = {}  # with the step before the first of the drift
        self._fired: list[int | None] = [None] * len(scene.events)
        self._first_seen: dict[str, int] = {}  # steps

    @property
    def objects(self) -> tuple[Placed, ...]:
        """The objects that are on the table now, in the order of the scene."""
        return tuple(self._at[p.label] for p in self.scene.on_table if p.label in self._at)

    def shares(self, world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """The share of each object [N] that a camera pose [4, 4] sees."""
        others = surroundings(self.scene) if self.scene.workspace is not None else NO_BOXES
        return seen_shares(world_from_camera, boxes_around(self.objects, self.sizes_m), others)

    def space(self) -> Space | None:
        """What the camera may do now. None where the rule of the paper holds."""
        if self.scene.workspace is None:
            return None
        boxes = boxes_of(surroundings(self.scene), boxes_around(self.objects, self.sizes_m))
        return Space(self.scene.workspace, boxes, self._also)

    def views(self, symmetry: int, spheres: Spheres) -> GoalViews | None:
        """The views that look like the goal image now. None if all of the target's kind were taken away."""
        target = self.scene.target_placed
        same = [target] if self.scene.target_absent else [p for p in self.objects if p.name == target.name]
        if not same:
            return None
        same.sort(key=lambda p: p.instance != target.instance)  # the one of the goal image is the first
        return views_of_all(self.scene.goal_world_from_camera, target.world_from_object,
                            np.array([p.world_from_object for p in same]), [p.instance for p in same], symmetry,
                            self.space(), spheres)

    def advance(self, step: int, shares: NDArray[np.float64]) -> list[str] | None:
        """Lets happen what happens with this step. `shares` are those of the objects in the image before it.

        Returns what happened, in words, which may be nothing new while an object drifts. None if all stands still.
        """
        for placed, share in zip(self.objects, shares, strict=True):
            if share >= IN_VIEW:
                self._first_seen.setdefault(placed.label, step - 1)
        happened = []
        for k, event in enumerate(self.scene.events):
            if self._fired[k] is None and self._is_due(k, event, step):
                self._fired[k] = step
                self._happen(event, step)
                happened.append(f"{event.kind} {event.label}")
        moving = False
        for label, (drift, start, since) in self._drifting.items():
            before, self._at[label] = self._at[label], drift.after(start, step - since)
            moving |= not np.array_equal(before.center_m, self._at[label].center_m)
        return happened if happened or moving else None

    def _is_due(self, k: int, event: Event, step: int) -> bool:
        if event.at_step is not None:
            return step >= event.at_step
        if event.after_in_view is not None:
            return step >= self._first_seen.get(event.label, step) + event.after_in_view
        before = self._fired[k - 1]
        return before is not None and event.after_previous is not None and step >= before + event.after_previous

    def _happen(self, event: Event, step: int) -> None:
        label = event.label
        self._drifting.pop(label, None)
        if event.kind == "taken":
            if label in self._at:
                self._away[label] = self._at.pop(label)
            return
        here = event.to or self._at.get(label) or self._away.get(label)
        if here is None:
            return  # the target that is absent from the scene
        self._away.pop(label, None)
        self._at[label] = here
        if event.drift is not None:
            self._drifting[label] = event.drift, here, step - 1


def place_of(scene: Scene) -> dict[str, Any]:
    """The fields of the goal message about the place. There are none for a scene without a workspace."""
    if scene.workspace is None:
        return {}
    table, reach = scene.table or PAPER_TABLE, scene.workspace
    place: dict[str, Any] = {"table_m": np.array([*table.size_xy_m, table.height_m])}
    if isinstance(reach, BoxReach):
        place["workspace_m"] = np.array([reach.lower_m, reach.upper_m])
    else:
        place["shell_m"] = np.array([*reach.center_m, reach.inner_m, reach.outer_m])
    if scene.obstacles:
        place["obstacle_centers_m"] = np.array([o.center_m for o in scene.obstacles])
        place["obstacle_sizes_m"] = np.array([o.size_m for o in scene.obstacles])
        place["obstacle_yaws_rad"] = np.array([o.yaw_rad for o in scene.obstacles])
    return place


def details_of(objects: Sequence[Placed], sizes_m: Sizes, shares: NDArray[np.float64],
               happened: list[str]) -> dict[str, Any]:
    """The fields of the truth that a scene as the paper's does not need."""
    boxes = boxes_around(objects, sizes_m)
    return {"instances": np.array([p.instance for p in objects], dtype=np.uint8), "rotations": boxes.rotations,
            "sizes_m": boxes.sizes_m, "in_view": shares, "events": happened}
