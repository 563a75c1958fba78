"""Scenes: which objects stand where, and which view is the goal.

A scene is read from a file, or drawn by the paper's rules (section 4.1). A file is JSON, `{"scenes": [...]}`, with one
map per scene. Its keys are those in scene_entry.py. Units are metres and radians, and the table top is at z = 0 unless
the scene says otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.services.simulator.scene import Placed, Scene
from saccade.services.simulator.scene_entry import entry_of, scene_from
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import MIB, parse_json, read_text, replace_whole, writing
from saccade.shared.world.geometry import direction, look_at
from saccade.shared.world.task import GOAL_CLEARANCE_M, clip, spheres_around

PAPER_SCENES = Path(__file__).parent / "scenes" / "paper_500.json"
HALF_SPREAD_M = 0.25  # objects stand in the square [-0.25, 0.25]^2
GOAL_RANGE_MAX_M = 0.50
MAX_FILE_BYTES, MAX_SCENES = 64 * MIB, 20_000
ROOM_SEED, ROOM_GOALS = 27_182_000, 20  # of the suite lexa-room: its seed, and the number of goals of each target
_NEED = "give a scenes file"
_TRIES = 100  # attempts to place an object before all objects are placed anew, and how often this is done

Sizes = Mapping[str, ArrayLike]  # name -> extents [3] of the object's box, metres


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
            scene = scene_from(entry, names)
            if scene.id in scenes:
                raise ValueError("its id occurs twice: make ids unique")
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise SaccadeError(f"scenes {path}, scene {told(name)}: {error}") from error
        scenes[scene.id] = scene
    return list(scenes.values())


def save_scenes(path: Path, scenes: Sequence[Scene]) -> None:
    """Writes scenes to a file that `load_scenes` can read."""
    text = '{"scenes": [\n' + ",\n".join(json.dumps(entry_of(scene)) for scene in scenes) + "\n]}\n"
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
    centers = np.c_[spread(rng, np.linalg.norm(extents[:, :2], axis=1) / 2), extents[:, 2] / 2]
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


def spread(rng: np.random.Generator, radii_m: NDArray[np.float64], half_m: float = HALF_SPREAD_M
           ) -> NDArray[np.float64]:
    """Draws points xy [N, 2] (metres) in a square of half the side `half_m` whose circles do not overlap. It starts
    again if an object finds no room.

    Raises SaccadeError if this fails too often.
    """
    for _ in range(_TRIES):
        points: list[NDArray[np.float64]] = []
        for radius in radii_m:
            for _ in range(_TRIES):
                point = rng.uniform(-half_m, half_m, 2)
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
