"""Scenes: which objects stand where, and which view is the goal.

A scene is read from a file, or drawn by the paper's rules (section 4.1). A file is JSON, `{"scenes": [...]}`, with one
map per scene. Its keys are those of SCENE_KEYS. Units are metres and radians, and the table top is at z = 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.shared.errors import SaccadeError, is_text, told
from saccade.shared.files import MIB, parse_json, read_text, replace_whole, writing
from saccade.shared.world.geometry import direction, look_at
from saccade.shared.world.task import GOAL_CLEARANCE_M, clip, spheres_around

PAPER_SCENES = Path(__file__).parent / "scenes" / "paper_500.json"
SCENE_KEYS = {"id", "target", "table_rgb", "objects", "goal_world_from_camera"}
OBJECT_KEYS = {"name", "center_xyz_m", "yaw_rad"}
HALF_SPREAD_M = 0.25  # objects stand in the square [-0.25, 0.25]^2
GOAL_RANGE_MAX_M = 0.50
MAX_FILE_BYTES, MAX_SCENES = 64 * MIB, 20_000
MAX_ID = 256  # characters of an id or a name: it is in messages and in file names
MAX_NUMBERS = {"center_xyz_m": 10.0, "goal_world_from_camera": 10.0, "yaw_rad": 1e4}  # what is further is not seen
ROOM_SEED, ROOM_GOALS = 27_182_000, 20  # of the suite lexa-room: its seed, and the number of goals of each target
_NEED = "give a scenes file"
_TRIES = 100  # attempts to place an object before all objects are placed anew, and how often this is done

Sizes = Mapping[str, ArrayLike]  # name -> extents [3] of the object's box, metres


@dataclass(frozen=True)
class Placed:
    """An object on the table: the centre of its box [3] (metres, world) and its yaw (radians)."""

    name: str
    center_m: NDArray[np.float64]
    yaw_rad: float


@dataclass(frozen=True)
class Scene:
    """The world of one episode. `table_rgb` is from 0 to 255; `goal_world_from_camera` [4, 4] is the goal view's pose.

    With `target_absent` the target does not stand on the table. Its position is then used for the goal image only.
    """

    id: str
    target: str
    table_rgb: tuple[int, int, int]
    objects: tuple[Placed, ...]
    goal_world_from_camera: NDArray[np.float64]
    target_absent: bool = False

    @property
    def target_placed(self) -> Placed:
        """The target and its position."""
        return next(placed for placed in self.objects if placed.name == self.target)

    @property
    def on_table(self) -> tuple[Placed, ...]:
        """The objects that stand on the table."""
        return tuple(p for p in self.objects if not (self.target_absent and p.name == self.target))


def load_scenes(path: Path, names: Sequence[str] | None = None) -> list[Scene]:
    """Reads and checks the scenes of a file. With `names` no other object may occur in them.

    Raises SaccadeError, in one line with the file and the scene, if anything is missing, damaged or contradictory.
    """
    text = read_text(path, "scenes", _NEED, MAX_FILE_BYTES)
    try:
        tree = parse_json(text)
    except ValueError as error:
        raise SaccadeError(f"scenes {path} is not JSON ({error}): write it with save_scenes") from error
    entries = tree.get("scenes") if isinstance(tree, dict) else None
    if not isinstance(entries, list) or not entries:
        raise SaccadeError(f'scenes {path} holds no scenes: it must be {{"scenes": [...]}} with at least one')
    if len(entries) > MAX_SCENES:
        raise SaccadeError(f"scenes {path} holds {len(entries)} scenes, more than {MAX_SCENES}: split it")
    scenes: dict[str, Scene] = {}
    for index, entry in enumerate(entries):
        name = entry.get("id", index) if isinstance(entry, dict) else index
        try:
            scene = _scene(entry, names)
            if scene.id in scenes:
                raise ValueError("its id occurs twice: make ids unique")
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise SaccadeError(f"scenes {path}, scene {told(name)}: {error}") from error
        scenes[scene.id] = scene
    return list(scenes.values())


def _scene(entry: Any, names: Sequence[str] | None) -> Scene:
    _check_keys(entry, SCENE_KEYS, {"target_absent"})
    _check_text(entry, "id")
    if not isinstance(entry["objects"], list) or not entry["objects"]:
        raise ValueError("objects must be a list of at least one object")
    objects = tuple(_placed(placed, names) for placed in entry["objects"])
    present = [placed.name for placed in objects]
    if len(set(present)) < len(present):
        raise ValueError("an object stands in it twice: name each at most once")
    if entry["target"] not in present:
        raise ValueError(f"target {told(entry['target'])} is not among its objects: add it, with "
                         "\"target_absent\": true if it must not stand on the table")
    absent = entry.get("target_absent", False)
    if not isinstance(absent, bool):
        raise ValueError("target_absent must be true or false")
    rgb = _numbers(entry, "table_rgb", (3,))
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == rgb.round())).all():
        raise ValueError("table_rgb must be three whole numbers from 0 to 255")
    goal = _numbers(entry, "goal_world_from_camera", (4, 4))
    rotation = goal[:3, :3]
    if (np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0
            or np.abs(goal[3] - (0, 0, 0, 1)).max() > 1e-6):
        raise ValueError("goal_world_from_camera is not a rigid transform")
    red, green, blue = (int(value) for value in rgb)
    return Scene(entry["id"], entry["target"], (red, green, blue), objects, goal, absent)


def _placed(entry: Any, names: Sequence[str] | None) -> Placed:
    _check_keys(entry, OBJECT_KEYS)
    name = entry["name"]
    _check_text(entry, "name")
    if names is not None and name not in names:
        raise ValueError(f"object {told(name)} is not in use: choose the set that has it (have {', '.join(names)})")
    return Placed(name, _numbers(entry, "center_xyz_m", (3,)), float(_numbers(entry, "yaw_rad", ())))


def _check_text(entry: dict[str, Any], key: str) -> None:
    text = entry[key]
    if not isinstance(text, str) or not text:
        raise ValueError(f"{key} must be a text")
    if len(text) > MAX_ID:
        raise ValueError(f"{key} has {len(text)} characters: shorten it to {MAX_ID}")
    if not is_text(text):
        raise ValueError(f"{key} must be Unicode without control codes: remove what is none")


def _check_keys(entry: Any, required: Set[str], optional: Set[str] = frozenset()) -> None:
    if not isinstance(entry, dict):
        raise ValueError("not a map")
    if missing := sorted(required - entry.keys()):
        raise ValueError(f"{missing[0]} is missing")
    if unknown := sorted(entry.keys() - required - optional):
        raise ValueError(f"{told(unknown[0])[1:-1]} is unknown: remove it")


def _numbers(entry: dict[str, Any], key: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    if not _has_shape(entry[key], shape):
        raise ValueError(f"{key} must be numbers of shape {list(shape)}")
    try:
        raw = np.array(entry[key], dtype=np.float64)
    except OverflowError as error:
        raise ValueError(f"{key} is larger than any number here") from error
    if not np.isfinite(raw).all():
        raise ValueError(f"{key} is not finite")
    if np.abs(raw).max() > (most := MAX_NUMBERS.get(key, np.inf)):
        raise ValueError(f"{key} must be within ±{most:g}")
    return raw


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether it is lists of that shape with nothing but numbers in them, before an array is made of it."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(one, shape[1:]) for one in value)


def save_scenes(path: Path, scenes: Sequence[Scene]) -> None:
    """Writes scenes to a file that `load_scenes` can read."""
    entries = []
    for scene in scenes:
        entry: dict[str, Any] = {
            "id": scene.id, "target": scene.target, "table_rgb": list(scene.table_rgb),
            "objects": [{"name": p.name, "center_xyz_m": p.center_m.tolist(), "yaw_rad": p.yaw_rad}
                        for p in scene.objects],
            "goal_world_from_camera": scene.goal_world_from_camera.tolist()}
        entries.append(entry | ({"target_absent": True} if scene.target_absent else {}))
    text = '{"scenes": [\n' + ",\n".join(json.dumps(entry) for entry in entries) + "\n]}\n"
    with writing(path, "scenes"):
        replace_whole(path, text.encode())


def generate_scene(rng: np.random.Generator, sizes: Sizes, target: str, n_objects: int, *,
                   yaw: Literal["random", "fixed"] = "random", scene_id: str = "drawn") -> Scene:
    """Draws a scene with `n_objects` different objects, as the benchmark's generator does (paper, section 4.1).

    With `yaw="fixed"` no object is turned, as in the paper. Raises SaccadeError if the target is unknown, if there are
    not so many objects, or if they do not fit on the table.
    """
    if target not in sizes:
        raise SaccadeError(f"target {target!r} is not among the objects: choose from {', '.join(sizes)}")
    if not 1 <= n_objects <= len(sizes):
        raise SaccadeError(f"{n_objects} objects asked for, {len(sizes)} there: lower scene.n_objects or add names")
    others = [name for name in sizes if name != target]
    names = [target, *(others[i] for i in rng.permutation(len(others))[:n_objects - 1])]
    names = [names[i] for i in rng.permutation(n_objects)]
    extents = np.array([sizes[name] for name in names], dtype=np.float64)
    centers = np.c_[_spread(rng, np.linalg.norm(extents[:, :2], axis=1) / 2), extents[:, 2] / 2]
    yaws = rng.uniform(-np.pi, np.pi, n_objects) if yaw == "random" else np.zeros(n_objects)
    index = names.index(target)
    goal = draw_goal(rng, centers, extents, index)
    red, green, blue = (int(value) for value in rng.integers(0, 256, 3))
    objects = tuple(Placed(*placed) for placed in zip(names, centers, yaws.tolist(), strict=True))
    return Scene(scene_id, target, (red, green, blue), objects, goal)


def draw_goal(rng: np.random.Generator, centers_m: ArrayLike, sizes_m: ArrayLike, index: int) -> NDArray[np.float64]:
    """Draws a goal view world_from_camera [4, 4] of object `index` (paper, section 4.1).

    The objects have box centres [N, 3] and extents [N, 3] (metres).
    """
    centers, extents = np.asarray(centers_m, dtype=np.float64), np.asarray(sizes_m, dtype=np.float64)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi / 2)
    nearest = min(float(np.linalg.norm(extents[index])) / 2 + GOAL_CLEARANCE_M, GOAL_RANGE_MAX_M)
    position = centers[index] + rng.uniform(nearest, GOAL_RANGE_MAX_M) * direction(azimuth, elevation)
    goal = look_at(position, centers[index])
    goal[:3, 3] = clip(position, spheres_around(centers, extents))
    return goal


def _spread(rng: np.random.Generator, radii_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draws points xy [N, 2] (metres) whose circles do not overlap. It starts again if an object finds no room.

    Raises SaccadeError if this fails too often.
    """
    for _ in range(_TRIES):
        points: list[NDArray[np.float64]] = []
        for radius in radii_m:
            for _ in range(_TRIES):
                point = rng.uniform(-HALF_SPREAD_M, HALF_SPREAD_M, 2)
                if all(np.linalg.norm(point - p) >= radius + r for p, r in zip(points, radii_m, strict=False)):
                    points.append(point)
                    break
        if len(points) == len(radii_m):
            return np.array(points)
    raise SaccadeError(f"{len(radii_m)} objects do not fit on the table side by side: lower scene.n_objects")


def generate_split(sizes: Sizes, *, seed: int, targets: Sequence[str] | None = None,
                   counts: Sequence[int] = (1, 2, 3, 4, 5), repeats: int = 20,
                   yaw: Literal["random", "fixed"] = "random") -> list[Scene]:
    """Draws a split like the paper's: `repeats` scenes for each target and each number of objects.

    The same arguments draw the same scenes. Raises SaccadeError as `generate_scene` does.
    """
    scenes: list[Scene] = []
    for target in targets if targets is not None else tuple(sizes):
        for count in counts:
            for repeat in range(repeats):
                number = seed + len(scenes)
                rng = np.random.default_rng([seed, list(sizes).index(target), count, repeat])
                scenes.append(generate_scene(rng, sizes, target, count, yaw=yaw, scene_id=f"{target}-{count}-{number}"))
    return scenes


def overlapping(scene: Scene, sizes: Sizes) -> list[tuple[str, str]]:
    """The pairs of objects whose bounding circles on the table overlap. A generated scene has none."""
    radius = {p.name: np.linalg.norm(np.asarray(sizes[p.name], dtype=np.float64)[:2]) / 2 for p in scene.objects}
    return [(a.name, b.name) for a, b in combinations(scene.objects, 2)
            if np.linalg.norm((a.center_m - b.center_m)[:2]) < radius[a.name] + radius[b.name] - 1e-9]


def room_scenes(sizes: Sizes) -> list[Scene]:
    """One table with all objects, never turned, and goals by the paper's rule. It repeats the paper's comparison with
    LEXA."""
    rng, names = np.random.default_rng(ROOM_SEED), tuple(sizes)
    room = generate_scene(rng, sizes, names[0], len(names), yaw="fixed")
    present = [placed.name for placed in room.objects]
    centers = [p.center_m for p in room.objects]
    extents = np.array([sizes[name] for name in present], dtype=np.float64)
    return [replace(room, id=f"lexa-{ROOM_GOALS * k + goal}", target=target,
                    goal_world_from_camera=draw_goal(rng, centers, extents, present.index(target)))
            for k, target in enumerate(names) for goal in range(ROOM_GOALS)]
