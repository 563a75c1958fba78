"""One scene of a scenes file: from the map in the file, and back. What is wrong raises ValueError."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from saccade.services.simulator.fields import (
    check_keys,
    check_text,
    colour,
    entries,
    flag,
    number,
    numbers,
    rigid,
    whole,
)
from saccade.services.simulator.scene import Drift, Event, EventKind, Obstacle, Placed, Scene, Table
from saccade.shared.config import MANY
from saccade.shared.errors import told
from saccade.shared.world.workspace import BoxReach, Reach, ShellReach

MOST_OBJECTS, MOST_INSTANCES, MOST_OBSTACLES, MOST_EVENTS = 255, 255, 32, 64
MAX_DRIFT_M = 0.02  # a step
SCENE_KEYS = {"id", "target", "table_rgb", "objects", "goal_world_from_camera"}
MORE_KEYS = {"target_absent", "target_instance", "start_world_from_camera", "workspace", "table", "obstacles", "events"}
NEED_WORKSPACE = ("start_world_from_camera", "table", "obstacles")
TURNED = {"yaw_rad", "quaternion_xyzw"}
WHEN = ("at_step", "after_in_view", "after_previous")
DRIFT = {"velocity_xy_m", "about_xy_m", "turn_rad", "turns", "steps", "back_after_steps"}
EVENT_KEYS: dict[EventKind, set[str]] = {
    "moved": {"center_xyz_m", *TURNED}, "taken": set(), "put_back": {"center_xyz_m", *TURNED},
    "pushed_over": {"center_xyz_m", *TURNED}, "drifts": DRIFT}


def scene_from(entry: Any, names: Sequence[str] | None) -> Scene:
    """The scene in a map. With `names` no other object may occur in it."""
    check_keys(entry, SCENE_KEYS, MORE_KEYS)
    check_text(entry, "id")
    if not isinstance(entry["objects"], list) or not entry["objects"]:
        raise ValueError("objects must be a list of at least one object")
    objects = tuple(_object(placed, names) for placed in entries(entry, "objects", MOST_OBJECTS))
    present = [placed.label for placed in objects]
    if len(set(present)) < len(present):
        raise ValueError("an object stands in it twice: give every further one of its name an instance of its own, "
                         "such as 2")
    instance = whole(entry, "target_instance", 1, MOST_INSTANCES, default=1)
    if not any((p.name, p.instance) == (entry["target"], instance) for p in objects):
        raise ValueError(f"target {told(entry['target'])} is not among its objects: add it, with "
                         "\"target_absent\": true if it must not stand on the table")
    absent = flag(entry, "target_absent", default=False)
    if absent and sum(p.name == entry["target"] for p in objects) > 1:
        raise ValueError("target_absent is true, and there are several of the target: leave one")
    if "workspace" not in entry and (needy := [key for key in NEED_WORKSPACE if key in entry]):
        raise ValueError(f"{needy[0]} needs a workspace: add it")
    start = rigid(entry, "start_world_from_camera") if "start_world_from_camera" in entry else None
    return Scene(entry["id"], entry["target"], colour(entry, "table_rgb"), objects,
                 rigid(entry, "goal_world_from_camera"), absent, instance, start,
                 _workspace(entry["workspace"]) if "workspace" in entry else None,
                 _table(entry["table"]) if "table" in entry else None,
                 tuple(_named(_obstacle, one, f"obstacle {k}")
                       for k, one in enumerate(entries(entry, "obstacles", MOST_OBSTACLES))),
                 _events(entries(entry, "events", MOST_EVENTS), objects))


def _named(make: Any, entry: Any, where: str) -> Any:
    try:
        return make(entry)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _object(entry: Any, names: Sequence[str] | None) -> Placed:
    check_keys(entry, {"name", "center_xyz_m"}, {"instance", *TURNED})
    name = check_text(entry, "name")
    if names is not None and name not in names:
        raise ValueError(f"object {told(name)} is not in use: choose the set that has it (have {', '.join(names)})")
    return _placed(entry, name, whole(entry, "instance", 1, MOST_INSTANCES, default=1))


def _placed(entry: dict[str, Any], name: str, instance: int) -> Placed:
    if "yaw_rad" not in entry and "quaternion_xyzw" not in entry:
        raise ValueError("yaw_rad is missing: give it, or quaternion_xyzw")
    if "quaternion_xyzw" not in entry:
        return Placed(name, numbers(entry, "center_xyz_m", (3,)), number(entry, "yaw_rad"), instance)
    if "yaw_rad" in entry:
        raise ValueError("yaw_rad and quaternion_xyzw are both given: leave one out")
    turned = numbers(entry, "quaternion_xyzw", (4,))
    if abs(np.linalg.norm(turned) - 1.0) > 1e-3:
        raise ValueError("quaternion_xyzw must have length 1")
    x, y, z, w = (float(value) for value in turned)
    return Placed(name, numbers(entry, "center_xyz_m", (3,)), 0.0, instance, (x, y, z, w))


def _workspace(entry: Any) -> Reach:
    if isinstance(entry, dict) and "inner_m" in entry:
        check_keys(entry, {"center_xyz_m", "inner_m", "outer_m"})
        inner, outer = number(entry, "inner_m", 0, 3), number(entry, "outer_m", 0, 3)
        if outer < inner + 0.05:
            raise ValueError("workspace: outer_m must be at least 0.05 m more than inner_m")
        return ShellReach(numbers(entry, "center_xyz_m", (3,), -3, 3), inner, outer)
    check_keys(entry, {"lower_xyz_m", "upper_xyz_m"})
    lower, upper = (numbers(entry, key, (3,), -3, 3) for key in ("lower_xyz_m", "upper_xyz_m"))
    if (upper - lower).min() < 0.05:
        raise ValueError("workspace: upper_xyz_m must be at least 0.05 m above lower_xyz_m in each axis")
    return BoxReach(lower, upper)


def _table(entry: Any) -> Table:
    check_keys(entry, {"size_xy_m"}, {"height_m"})
    x, y = (float(side) for side in numbers(entry, "size_xy_m", (2,), 0.1, 4))
    return Table((x, y), number({"height_m": 0.0} | entry, "height_m", -1, 1))


def _obstacle(entry: Any) -> Obstacle:
    check_keys(entry, {"center_xyz_m", "size_xyz_m"}, {"yaw_rad", "rgb"})
    made = Obstacle(numbers(entry, "center_xyz_m", (3,)), numbers(entry, "size_xyz_m", (3,), 0.001, 4),
                    number({"yaw_rad": 0.0} | entry, "yaw_rad"))
    return made if "rgb" not in entry else Obstacle(made.center_m, made.size_m, made.yaw_rad, colour(entry, "rgb"))


def _events(told_events: list[Any], objects: Sequence[Placed]) -> tuple[Event, ...]:
    at, events = {placed.label: placed for placed in objects}, []
    for k, entry in enumerate(told_events):
        try:
            event = _event(entry, first=k == 0)
            if event.label not in at:
                raise ValueError(f"{told(event.label)} is not among the objects of the scene")
            if event.drift is not None and event.drift.speed_m(at[event.label]) > MAX_DRIFT_M + 1e-9:
                raise ValueError(f"it drifts by more than {MAX_DRIFT_M:g} m a step: make it slower")
            at[event.label] = event.to or at[event.label]
        except ValueError as error:
            raise ValueError(f"event {k}: {error}") from error
        events.append(event)
    return tuple(events)


def _event(entry: Any, *, first: bool) -> Event:
    told_kind = entry.get("event") if isinstance(entry, dict) else None
    kind = next((known for known in EVENT_KEYS if known == told_kind), None)
    if kind is None:
        raise ValueError(f"event must be one of {', '.join(EVENT_KEYS)}")
    check_keys(entry, {"event", "name"}, {"instance", *WHEN, *EVENT_KEYS[kind]})
    given = [key for key in WHEN if key in entry]
    if len(given) != 1:
        raise ValueError(f"say when it happens with exactly one of {', '.join(WHEN)}")
    if given == ["after_previous"] and first:
        raise ValueError("after_previous needs an event before it in the list")
    when = {key: whole(entry, key, 1, MANY) for key in given}
    name, instance = check_text(entry, "name"), whole(entry, "instance", 1, MOST_INSTANCES, default=1)
    to = None
    if kind in ("moved", "pushed_over") or entry.keys() & {"center_xyz_m", *TURNED}:
        if "center_xyz_m" not in entry:
            raise ValueError("center_xyz_m is missing")
        to = _placed(entry, name, instance)
    return Event(kind, name, instance, to=to, drift=_drift(entry) if kind == "drifts" else None, **when)


def _drift(entry: dict[str, Any]) -> Drift:
    steps, back = (whole(entry, key, 1, MANY) if key in entry else None for key in ("steps", "back_after_steps"))
    if ("velocity_xy_m" in entry) == ("about_xy_m" in entry):
        raise ValueError("say how it drifts with velocity_xy_m, or with about_xy_m and turn_rad")
    if "velocity_xy_m" in entry:
        if entry.keys() & {"turn_rad", "turns"}:
            raise ValueError("turn_rad and turns belong to about_xy_m, not to velocity_xy_m: remove them")
        x, y = (float(value) for value in numbers(entry, "velocity_xy_m", (2,)))
        return Drift((x, y), steps=steps, back_after_steps=back)
    if "turn_rad" not in entry:
        raise ValueError("turn_rad is missing")
    x, y = (float(value) for value in numbers(entry, "about_xy_m", (2,)))
    return Drift((0.0, 0.0), (x, y), number(entry, "turn_rad"), flag(entry, "turns", default=True), steps, back)


def entry_of(scene: Scene) -> dict[str, Any]:
    """The map of a scene, from which `scene_from` makes it again. It holds only what is not the default."""
    entry: dict[str, Any] = {
        "id": scene.id, "target": scene.target, "table_rgb": list(scene.table_rgb),
        "objects": [{"name": p.name} | _instance(p.instance) | _pose_entry(p) for p in scene.objects],
        "goal_world_from_camera": scene.goal_world_from_camera.tolist()}
    if scene.target_absent:
        entry["target_absent"] = True
    if scene.target_instance != 1:
        entry["target_instance"] = scene.target_instance
    if scene.start_world_from_camera is not None:
        entry["start_world_from_camera"] = scene.start_world_from_camera.tolist()
    if scene.workspace is not None:
        entry["workspace"] = _workspace_entry(scene.workspace)
    if scene.table is not None:
        entry["table"] = {"size_xy_m": list(scene.table.size_xy_m), "height_m": scene.table.height_m}
    if scene.obstacles:
        entry["obstacles"] = [{"center_xyz_m": o.center_m.tolist(), "size_xyz_m": o.size_m.tolist(),
                               "yaw_rad": o.yaw_rad, "rgb": list(o.rgb)} for o in scene.obstacles]
    if scene.events:
        entry["events"] = [_event_entry(event) for event in scene.events]
    return entry


def _instance(instance: int) -> dict[str, Any]:
    return {} if instance == 1 else {"instance": instance}


def _pose_entry(placed: Placed) -> dict[str, Any]:
    turned = {"yaw_rad": placed.yaw_rad} if placed.quaternion_xyzw is None else {
        "quaternion_xyzw": list(placed.quaternion_xyzw)}
    return {"center_xyz_m": placed.center_m.tolist()} | turned


def _workspace_entry(reach: Reach) -> dict[str, Any]:
    if isinstance(reach, BoxReach):
        return {"lower_xyz_m": reach.lower_m.tolist(), "upper_xyz_m": reach.upper_m.tolist()}
    return {"center_xyz_m": reach.center_m.tolist(), "inner_m": reach.inner_m, "outer_m": reach.outer_m}


def _event_entry(event: Event) -> dict[str, Any]:
    entry: dict[str, Any] = {"event": event.kind, "name": event.name} | _instance(event.instance)
    entry |= {key: value for key in WHEN if (value := getattr(event, key)) is not None}
    entry |= _pose_entry(event.to) if event.to is not None else {}
    if (drift := event.drift) is not None:
        if drift.about_xy_m is None:
            entry["velocity_xy_m"] = list(drift.velocity_m)
        else:
            entry |= {"about_xy_m": list(drift.about_xy_m), "turn_rad": drift.turn_rad, "turns": drift.turns}
        entry |= {key: value for key in ("steps", "back_after_steps") if (value := getattr(drift, key)) is not None}
    return entry
