"""Tables as tables are: scenes with several of a kind, lying, moving, crowded, and seen from anywhere.

Each kind of table is a function that tries to draw one scene for a target. It returns None where the draw does not
fit, and is then called again. Every scene has a workspace, and a way leads from its start to its goal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from saccade.services.simulator.physics import at_rest, height_on
from saccade.services.simulator.scene import Drift, Event, Obstacle, Placed, Scene, Table, placed_at, surroundings
from saccade.services.simulator.scenes import GOAL_RANGE_MAX_M, spread
from saccade.services.simulator.stage import boxes_around
from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh import Mesh
from saccade.shared.world.geometry import Array, direction, look_at, rotation_of, rotation_xyz, yaw_rotation
from saccade.shared.world.sight import IN_VIEW, seen_shares
from saccade.shared.world.task import LOWER_M, UPPER_M, start_pose
from saccade.shared.world.ways import find_way
from saccade.shared.world.workspace import CLEARANCE_M, BoxReach, Reach, ShellReach, Space, boxes_of

Meshes = Mapping[str, Mesh]
COUNT = 200  # scenes of a suite
MOST_DRAWN, MOST_OBSTACLES = 15, 3  # objects, and obstacles, of a scene
_TRIES, _GOALS, _CROWDED = 400, 30, 3  # how often a scene is drawn, a goal for it, and objects that do not fit
PAPER_REACH = BoxReach(LOWER_M, UPPER_M)
HALF_SPREAD_M, HEAP_M, HEAP_EDGE_M = 0.28, 0.07, 0.36
STEP_M = 0.05  # of an agent: how far it comes before something happens
MAX_GOAL_STEP_M = 0.03  # of a goal's view, where its object drifts
TIPPED_RAD = 1.2  # how far an object is tipped before it falls over


def draw_table(kind: str, rng: Generator, meshes: Meshes, target: str, number: int, scene_id: str) -> Scene:
    """Draws one scene. `number` counts the scenes of a suite, so that what happens in them takes turns.

    Raises SaccadeError if the objects do not fit.
    """
    crowded = 0
    for _ in range(_TRIES):
        try:
            scene = TABLES[kind](rng, meshes, target, number)
        except SaccadeError:  # they do not fit side by side; fewer or others may
            scene, crowded = None, crowded + 1
        if scene is not None:
            return replace(scene, id=scene_id)
        if crowded == _CROWDED:
            break
    raise SaccadeError(f"a scene of {kind!r} with the target {target!r} does not fit on the table: choose smaller "
                       "objects with --names")


def draw_tables(kind: str, meshes: Meshes, seed: int, count: int = COUNT) -> list[Scene]:
    """The scenes of a suite. The same seed draws the same scenes, each of which depends on its own number only."""
    names = tuple(meshes)
    return [draw_table(kind, np.random.default_rng([list(TABLES).index(kind), seed, k]), meshes, names[k % len(names)],
                       k // len(names), f"{kind}-{seed}.{k}") for k in range(count)]


def _twins(rng: Generator, meshes: Meshes, target: str, _number: int) -> Scene | None:
    """Two to four of the target's kind among five to seven objects."""
    count, same = int(rng.integers(5, 8)), int(rng.integers(2, 5))
    names = [target] * same + _others(rng, meshes, target, count - same)
    return _with_goal(rng, meshes, _scene(rng, target, _standing(rng, meshes, names)))


def _lying(rng: Generator, meshes: Meshes, target: str, _number: int) -> Scene | None:
    """One to five objects as they came to rest after a fall. The camera and the goal are rolled."""
    names = [target, *_others(rng, meshes, target, int(rng.integers(0, min(5, len(meshes)))))]
    radii = [float(np.linalg.norm(meshes[name].size_m)) / 2 for name in names]
    places = spread(rng, np.array(radii), HALF_SPREAD_M)
    rest = at_rest(meshes, [placed_at(name, 1, np.array([*place, radius + 0.01]), _any_rotation(rng))
                            for name, place, radius in zip(names, places, radii, strict=True)])
    if rest is None or any(np.abs(p.center_m[:2]).max() > HEAP_EDGE_M for p in rest):
        return None
    scene = _scene(rng, target, rest, start=_rolled(rng, start_pose()))
    return _with_goal(rng, meshes, scene, rolled=True)


def _moving(rng: Generator, meshes: Meshes, target: str, number: int) -> Scene | None:
    """Three to five standing objects. Once the target was in view, it is moved, taken away for ten steps, or pushed
    over."""
    names = [target, *_others(rng, meshes, target, int(rng.integers(2, 5)))]
    scene = _with_goal(rng, meshes, _scene(rng, target, _standing(rng, meshes, names)))
    if scene is None:
        return None
    soon = int(rng.integers(2, 5))
    away = np.linalg.norm(scene.goal_world_from_camera[:3, 3] - start_pose()[:3, 3])
    if away < STEP_M * (soon + 2) + 0.1 or _seen(meshes, scene, start_pose()) < IN_VIEW:
        return None  # it might be over before anything happens
    happens = (_moved, _taken, _pushed_over)[number % 3](rng, meshes, scene, soon)
    return _if_reachable_later(meshes, replace(scene, events=happens)) if happens else None


def _moved(rng: Generator, meshes: Meshes, scene: Scene, soon: int) -> tuple[Event, ...]:
    target = scene.target_placed
    shift = rng.uniform(0.1, 0.3) * direction(rng.uniform(0, 2 * np.pi), 0.0)
    to = replace(target, center_m=target.center_m + shift, yaw_rad=float(rng.uniform(-np.pi, np.pi)))
    others = [p for p in scene.objects if p is not target]
    apart = all(np.linalg.norm((to.center_m - p.center_m)[:2]) >= _radius(meshes, to) + _radius(meshes, p)
                for p in others)
    if not apart or np.abs(to.center_m[:2]).max() > HEAP_EDGE_M:
        return ()
    return (Event("moved", target.name, after_in_view=soon, to=to),)


def _taken(_rng: Generator, _meshes: Meshes, scene: Scene, soon: int) -> tuple[Event, ...]:
    return (Event("taken", scene.target, after_in_view=soon), Event("put_back", scene.target, after_previous=10))


def _pushed_over(rng: Generator, meshes: Meshes, scene: Scene, soon: int) -> tuple[Event, ...]:
    target, azimuth = scene.target_placed, rng.uniform(0, 2 * np.pi)
    tipped = yaw_rotation(azimuth) @ rotation_xyz((0.0, TIPPED_RAD, 0.0)) @ yaw_rotation(-azimuth) @ target.rotation
    top = target.center_m + 0.5 * meshes[target.name].size_m[2] * direction(azimuth, 0.0)
    falling = placed_at(target.name, target.instance,
                        np.array([*top[:2], height_on(meshes[target.name], tipped)]), tipped)
    rest = at_rest(meshes, [falling], standing=[p for p in scene.objects if p is not target])
    if rest is None or rest[0].rotation[2, 2] > 0.5 or np.abs(rest[0].center_m[:2]).max() > HEAP_EDGE_M:
        return ()
    return (Event("pushed_over", target.name, after_in_view=soon, to=rest[0]),)


def _drifting(rng: Generator, meshes: Meshes, target: str, number: int) -> Scene | None:
    """Two to four standing objects. The target goes to and fro along an arc, in every other scene turning with it."""
    names = [target, *_others(rng, meshes, target, int(rng.integers(1, 4)))]
    scene = _with_goal(rng, meshes, _scene(rng, target, _standing(rng, meshes, names)))
    if scene is None:
        return None
    placed, speed, radius = scene.target_placed, rng.uniform(0.005, 0.02), rng.uniform(0.12, 0.5)
    about = placed.center_m[:2] + radius * direction(rng.uniform(0, 2 * np.pi), 0.0)[:2]
    turn = float(rng.choice([-1.0, 1.0])) * speed / radius
    back = int(np.ceil(rng.uniform(0.15, 0.4) / speed))
    drift = Drift((0.0, 0.0), (float(about[0]), float(about[1])), turn, bool(number % 2), None, back)
    path = [drift.after(placed, k).center_m[:2] for k in range(back + 1)]
    clear = all(np.linalg.norm(np.array(path) - p.center_m[:2], axis=1).min() >= _radius(meshes, placed)
                + _radius(meshes, p) for p in scene.objects if p is not placed)
    goal = np.linalg.norm(scene.goal_world_from_camera[:2, 3] - about)
    if not clear or np.abs(path).max() > HEAP_EDGE_M or (drift.turns and abs(turn) * goal > MAX_GOAL_STEP_M):
        return None
    event = Event("drifts", target, at_step=1, drift=drift)
    return _if_reachable_later(meshes, replace(scene, events=(event,)), steps=back)


def _crowd(rng: Generator, meshes: Meshes, target: str, _number: int) -> Scene | None:
    """Ten to fifteen objects, dropped in a heap."""
    names = [target, *_others(rng, meshes, target, int(rng.integers(9, MOST_DRAWN)), repeated=True)]
    names = [names[k] for k in rng.permutation(len(names))]
    falling = [placed_at(p.name, p.instance, np.array([*rng.uniform(-HEAP_M, HEAP_M, 2), 0.15]), _any_rotation(rng))
               for p in _numbered(names)]
    rest = at_rest(meshes, falling)
    if rest is None or any(np.abs(p.center_m[:2]).max() > HEAP_EDGE_M for p in rest):
        return None
    same = [p.instance for p in rest if p.name == target]
    scene = _scene(rng, target, rest, instance=int(rng.choice(same)))
    return _with_goal(rng, meshes, scene)


def _anywhere(rng: Generator, meshes: Meshes, target: str, _number: int) -> Scene | None:
    """One to five standing objects on a table of any size and height, among obstacles, from anywhere."""
    x, y = (float(side) for side in rng.uniform(0.7, 1.4, 2))
    table = Table((x, y), float(rng.uniform(-0.2, 0.3)))
    names = [target, *_others(rng, meshes, target, int(rng.integers(0, min(5, len(meshes)))))]
    objects = _standing(rng, meshes, names, half_m=min(x, y) / 2 - 0.1, top_m=table.height_m)
    obstacles = tuple(_obstacle(rng, table) for _ in range(rng.integers(1, MOST_OBSTACLES + 1)))
    scene = replace(_scene(rng, target, objects, reach=_any_reach(rng, table)), table=table, obstacles=obstacles)
    apart = boxes_around(objects, _sizes(meshes)).centers_m
    if (surroundings(scene).distances_m(apart)[:, :-1] < 0.12).any():
        return None
    space = _space(meshes, scene)
    lower, upper = space.reach.bounds_m()
    eyes = rng.uniform(lower, upper, (50, 3))
    eyes = eyes[space.allows(eyes)]
    if not len(eyes):
        return None
    start = look_at(eyes[0], [*rng.uniform(-0.3, 0.3, 2), table.height_m])
    return _with_goal(rng, meshes, replace(scene, start_world_from_camera=start))


TABLES: dict[str, Callable[[Generator, Meshes, str, int], Scene | None]] = {
    "twins": _twins, "lying": _lying, "moving": _moving, "drifting": _drifting, "crowd": _crowd, "anywhere": _anywhere}

LYING = ("lying", "moving", "crowd")  # in which objects do not all stand


def _any_reach(rng: Generator, table: Table) -> Reach:
    """A box above the table, or the shell that an arm beside it reaches."""
    x, y = table.size_xy_m
    if rng.random() < 0.5:
        a, b = rng.uniform(0.45, 0.8, 2)
        return BoxReach(np.array([-a, -b, table.height_m + 0.08]),
                        np.array([a, b, table.height_m + rng.uniform(0.45, 0.8)]))
    azimuth = rng.uniform(0, 2 * np.pi)
    foot = (max(x, y) / 2 + 0.05) * direction(azimuth, 0.0)
    return ShellReach(np.array([*foot[:2], table.height_m + 0.1]), 0.25, float(rng.uniform(0.9, 1.3)))


def _obstacle(rng: Generator, table: Table) -> Obstacle:
    """A wall or a block that stands on the height of the table."""
    if rng.random() < 0.5:
        size = np.array([0.02, rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.5)])
    else:
        size = rng.uniform(0.1, 0.25, 3)
    place = rng.uniform(0.3, 0.6) * direction(rng.uniform(0, 2 * np.pi), 0.0)
    red, green, blue = (int(value) for value in rng.integers(60, 220, 3))
    return Obstacle(np.array([*place[:2], table.height_m + size[2] / 2]), size, float(rng.uniform(-np.pi, np.pi)),
                    (red, green, blue))


def _others(rng: Generator, meshes: Meshes, target: str, count: int, *, repeated: bool = False) -> list[str]:
    """The names of so many further objects: of other kinds, each once if there are enough of them."""
    names = [name for name in meshes if name != target] or [target]
    if repeated:
        return [str(name) for name in rng.choice(list(meshes), count)]
    return [names[k % len(names)] for k in rng.permutation(max(count, len(names)))[:count]]


def _numbered(names: Sequence[str]) -> list[Placed]:
    """Objects without a place, each with its number among those of its kind."""
    return [Placed(name, np.zeros(3), 0.0, names[:k].count(name) + 1) for k, name in enumerate(names)]


def _standing(rng: Generator, meshes: Meshes, names: Sequence[str], *, half_m: float = HALF_SPREAD_M,
              top_m: float = 0.0) -> tuple[Placed, ...]:
    """Objects that stand side by side on the table, each turned at random. The first is the target."""
    radii = np.array([np.linalg.norm(meshes[name].size_m[:2]) / 2 for name in names])
    places = spread(rng, radii, min(half_m, HALF_SPREAD_M))
    return tuple(replace(p, center_m=np.array([*place, top_m + meshes[p.name].size_m[2] / 2]),
                         yaw_rad=float(rng.uniform(-np.pi, np.pi)))
                 for p, place in zip(_numbered(names), places, strict=True))


def _scene(rng: Generator, target: str, objects: Sequence[Placed], *, instance: int = 1, start: Array | None = None,
           reach: Reach = PAPER_REACH) -> Scene:
    red, green, blue = (int(value) for value in rng.integers(0, 256, 3))
    order = rng.permutation(len(objects))
    return Scene("drawn", target, (red, green, blue), tuple(objects[k] for k in order), np.eye(4),
                 target_instance=instance, start_world_from_camera=start, workspace=reach)


def _with_goal(rng: Generator, meshes: Meshes, scene: Scene, *, rolled: bool = False) -> Scene | None:
    """The scene with a goal view that shows the target, and to which a way leads. None if none is found."""
    space, target = _space(meshes, scene), scene.target_placed
    nearest = float(np.linalg.norm(meshes[target.name].size_m)) / 2 + CLEARANCE_M
    start = scene.start_world_from_camera if scene.start_world_from_camera is not None else start_pose()
    if not space.allows(start[:3, 3]):
        return None
    for _ in range(_GOALS):
        azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi / 2)
        eye = target.center_m + rng.uniform(min(nearest, GOAL_RANGE_MAX_M), GOAL_RANGE_MAX_M) * direction(
            azimuth, elevation)
        goal = look_at(eye, target.center_m)
        if rolled:
            goal = _rolled(rng, goal)
        if space.allows(eye) and _seen(meshes, scene, goal) >= IN_VIEW and find_way(space, start[:3, 3], [eye]):
            return replace(scene, goal_world_from_camera=goal)
    return None


def _if_reachable_later(meshes: Meshes, scene: Scene, steps: int = 1) -> Scene | None:
    """The scene, if a way leads to the goal's view also after its first event, and at least half of the time while
    something drifts."""
    event, target = scene.events[0], scene.target_placed
    reached, phases = 0, np.unique(np.linspace(1 if event.drift is None else 0, steps, 5).astype(int))
    for phase in phases:
        now = event.to or (event.drift.after(target, int(phase)) if event.drift is not None else target)
        later = replace(scene, events=(), objects=tuple(now if p is target else p for p in scene.objects))
        space = _space(meshes, later)
        goal = now.world_from_object @ np.linalg.inv(target.world_from_object) @ scene.goal_world_from_camera
        start = space.nearest(start_pose()[:3, 3])
        reached += bool(space.allows(goal[:3, 3])) and find_way(space, start, [goal[:3, 3]]) is not None
    return scene if reached >= max(1, len(phases) / 2) else None


def _sizes(meshes: Meshes) -> dict[str, Array]:
    return {name: mesh.size_m for name, mesh in meshes.items()}


def _space(meshes: Meshes, scene: Scene) -> Space:
    assert scene.workspace is not None  # every scene here has one
    return Space(scene.workspace, boxes_of(surroundings(scene), boxes_around(scene.objects, _sizes(meshes))))


def _seen(meshes: Meshes, scene: Scene, world_from_camera: Array) -> float:
    """The share of the target that a camera pose [4, 4] sees."""
    boxes = boxes_around(scene.objects, _sizes(meshes))
    index = [p.label for p in scene.objects].index(scene.target_placed.label)
    return float(seen_shares(world_from_camera, boxes, surroundings(scene))[index])


def _radius(meshes: Meshes, placed: Placed) -> float:
    return float(np.linalg.norm(meshes[placed.name].size_m[:2])) / 2


def _any_rotation(rng: Generator) -> Array:
    return rotation_of(rng.normal(size=4))


def _rolled(rng: Generator, world_from_camera: Array) -> Array:
    """A camera pose [4, 4], rolled at random about its optical axis."""
    rolled = world_from_camera.copy()
    rolled[:3, :3] = rolled[:3, :3] @ yaw_rotation(float(rng.uniform(-np.pi, np.pi)))
    return rolled
