"""`python -m saccade.benchmarks.hand FILE [N] [--seed S] [--board]` rehearses N searches in which a simulated hand
follows the guidance.

The hand holds the camera of the simulator. It does what the guidance says half a second later, with the speed of a
person and a person's sway, and the agent gets poses that are as inexact as those of a printed board. With `--board` it
gets them from printed boards in the image of a camera with faults (see `hand_eyes.py`). What FILE holds already is not
rehearsed again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.app.bench.table import wilson
from saccade.app.run.registry import agent_pairs
from saccade.benchmarks.board_scene import Film
from saccade.benchmarks.hand_eyes import RENDER_PX, Eyes, Filmed, Ideal, sheets
from saccade.services.simulator.scenes import Scene, generate_split
from saccade.shared.bus.messages import Action, Frame, Goal, Message, Plan
from saccade.shared.bus.topics import FRAME, GOAL, Output, Topic
from saccade.shared.config import Config
from saccade.shared.log.provenance import commit
from saccade.shared.loop.local import Pump
from saccade.shared.loop.service import Core, Service
from saccade.shared.loop.stepper import Stepper
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import IMAGE_SIZE_PX, Array, pose, rotation_angle
from saccade.shared.world.guidance import Guidance, guide, level_axes
from saccade.shared.world.task import Spheres, clip, equal_goals, nearest_goal, spheres_around, start_pose, success

OBJECTS, SEED, REPEATS, REHEARSALS = "ycb", 17_320_508, 2, 50
RATE_HZ, LONGEST_S = 10.0, 60.0
ANSWERED_EVERY = 2  # images; the agent's answer comes as many images later
REACTION_S = 0.5
SPEED_M_S, TURN_RAD_S = 0.2, np.radians(40)
EASE_S = 1.0  # near its aim the hand becomes slower: what is left is done in about this time
SWAY_M, SWAY_RAD, SWAY_HZ, SWAYS = 0.02, np.radians(3), (0.15, 1.0), 3  # root mean square of the whole displacement
LOST_S = 1.0  # after this time without a pose the hand goes back to where there was one, as the page asks for


class Sway:
    """What a hand does without wanting to: a smooth displacement [3] and rotation vector [3] at each time."""

    def __init__(self, rng: np.random.Generator):
        self._hz, self._phase = rng.uniform(*SWAY_HZ, (SWAYS, 6)), rng.uniform(0, 2 * np.pi, (SWAYS, 6))

    def at(self, time_s: float) -> tuple[Array, Array]:
        """The displacement in metres and the rotation vector in radians."""
        waves = np.sin(2 * np.pi * self._hz * time_s + self._phase).sum(0) * np.sqrt(2 / (3 * SWAYS))
        return SWAY_M * waves[:3], SWAY_RAD * waves[3:]


class Hand:
    """A hand that holds a camera, beginning at `start` [4, 4], and keeps it out of the spheres."""

    def __init__(self, start: Array, spheres: Spheres, rng: np.random.Generator):
        self._wanted, self._spheres, self._sway, self._time_s = np.array(start), spheres, Sway(rng), 0.0
        self._told: deque[Guidance] = deque(maxlen=round(REACTION_S * RATE_HZ) + 1)
        self.camera = self._held()

    def follow(self, guidance: Guidance) -> None:
        """Goes on for the time of one image, by the guidance of half a second ago."""
        self._told.append(guidance)
        self._time_s += 1 / RATE_HZ
        known = self._told[0] if len(self._told) == self._told.maxlen else None
        if known is not None and known.state == "move":
            self._move(known)
        self.camera = self._held()

    def _move(self, known: Guidance) -> None:
        """A person moves along the arrow as it points now, seen from the camera."""
        step = _limited(known.move_m / EASE_S, SPEED_M_S) / RATE_HZ
        turn = _limited(known.turns_rad[[1, 0, 2]] / EASE_S, TURN_RAD_S) / RATE_HZ
        position = clip(self._wanted[:3, 3] + level_axes(self.camera) @ step, self._spheres)
        self._wanted = pose(self._wanted[:3, :3] @ Rotation.from_rotvec(turn).as_matrix(), position)

    def _held(self) -> Array:
        aside, turned = self._sway.at(self._time_s)
        return pose(self._wanted[:3, :3] @ Rotation.from_rotvec(turned).as_matrix(),
                    clip(self._wanted[:3, 3] + aside, self._spheres))


def _limited(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector * min(1.0, most / max(length, 1e-9))


class Rehearsal:
    """One search. `pairs` are the agent's services. With a `film`, the camera's images and poses are those of the
    film; otherwise the images are the simulator's."""

    def __init__(self, world: World, scene: Scene, pairs: list[tuple[Service, Core]], names: tuple[str, ...],
                 number: int, *, seed: int = SEED, film: Film | None = None):
        self.world, self.scene, self._rng = world, scene, np.random.default_rng((seed, number))
        self.eyes: Eyes = Ideal(world, self._rng) if film is None else Filmed(film, scene, world.meshes, self._rng)
        self._at: dict[str, Any] = {"run": "hand", "episode": number}
        self._pump = Pump([Stepper(service, core, names, live=True) for service, core in pairs], self._hear)
        placed, meshes = scene.on_table, world.meshes
        self.spheres = spheres_around([p.center_m for p in placed], [meshes[p.name].size_m for p in placed])
        target = scene.target_placed
        self.goals = equal_goals(scene.goal_world_from_camera, target.center_m, meshes[target.name].symmetry,
                                 self.spheres)
        self.plan: Plan | None = None
        self._action: Action | None = None

    def run(self) -> dict[str, Any]:
        """Rehearses until the agent says that the camera is there, or the time is over. Returns the record."""
        self._begin()
        hand = Hand(start_pose(), self.spheres, self._rng)
        path, viewpoints, reached, told = [hand.camera], 0, False, None
        seen = None  # the camera's pose as it was measured last, as it was then, and when
        started_s, images = time.perf_counter(), round(LONGEST_S * RATE_HZ)
        for step in range(images):
            if self.plan is not None and step % ANSWERED_EVERY == 0:  # this answers the image before the last
                viewpoints += told is None or not np.array_equal(told[0].viewpoint, self.plan.viewpoint)
                told = self.plan, self._action
            reached |= step > 0 and self._there(hand.camera)
            if told is not None and told[0].arrived:
                break
            if step % ANSWERED_EVERY == 0:
                measured = self._look(path[-min(2, len(path))], hand.camera, step)
                seen = seen if measured is None else (measured, hand.camera, step)
            if seen is not None and step - seen[2] > LOST_S * RATE_HZ:
                hand.follow(guide(hand.camera, seen[1], self.scene.target_placed.center_m, self.world.intrinsics_px,
                                  (IMAGE_SIZE_PX,) * 2))
            elif told is not None and seen is not None:
                # What a person sees on the screen moves with the image, also between two measured poses.
                hand.follow(self._guidance(seen[0] @ np.linalg.inv(seen[1]) @ hand.camera, *told))
            path.append(hand.camera)
        declared = told is not None and told[0].arrived
        goal, metres = nearest_goal(hand.camera, self.goals), sum(
            float(np.linalg.norm(after[:3, 3] - before[:3, 3])) for before, after in pairwise(path))
        by_board = {} if not isinstance(self.eyes, Filmed) else {
            "images": self.eyes.images, "with_pose": len(self.eyes.apart_m),
            "pose_apart_m": None if not self.eyes.apart_m else {
                "median": round(float(np.median(self.eyes.apart_m)), 4), "most": round(max(self.eyes.apart_m), 4)}}
        return {"scene": self.scene.id, "reached": bool(reached), "declared": declared,
                "declared_rightly": declared and self._there(hand.camera),
                "seconds": round((len(path) - 1) / RATE_HZ, 1), "viewpoints": viewpoints, "metres": round(metres, 2),
                "apart_m": round(float(np.linalg.norm(hand.camera[:3, 3] - goal[:3, 3])), 3),
                "apart_rad": round(float(rotation_angle(hand.camera[:3, :3], goal[:3, :3])), 3),
                "computed_s": round(time.perf_counter() - started_s, 1), **by_board}

    def _begin(self) -> None:
        target = self.scene.target_placed
        self._place([target])
        rgb = self.world.render(self.scene.goal_world_from_camera)
        self._place(self.scene.on_table)
        self._pump.run([Output(GOAL, Goal(**self._at, step=0, rgb=rgb, intrinsics_px=self.world.intrinsics_px))])

    def _place(self, objects: Any) -> None:
        self.world.place({p.name: (p.center_m, p.yaw_rad) for p in objects}, self.scene.table_rgb)

    def _look(self, before: Array, camera: Array, step: int) -> Array | None:
        """Shows the agent an image, if its pose is known. Returns the pose as it is measured."""
        rgb, measured = self.eyes.look(before, camera, step / RATE_HZ)
        if measured is not None:
            self._pump.run([Output(FRAME, Frame(**self._at, step=step, rgb=rgb, world_from_camera=measured,
                                                intrinsics_px=self.world.intrinsics_px))])
        return measured

    def _hear(self, _topic: Topic, _part: str | None, message: Message, _payload: bytes | None) -> None:
        if isinstance(message, Plan):
            self.plan = message
        elif isinstance(message, Action):
            self._action = message

    def _guidance(self, measured: Array, plan: Plan, action: Action | None) -> Guidance:
        return guide(measured, plan.viewpoint, plan.look_at_m, self.world.intrinsics_px, (IMAGE_SIZE_PX,) * 2,
                     step_m=None if action is None else action.translation_m, there=plan.arrived)

    def _there(self, camera: Array) -> bool:
        return success(camera, nearest_goal(camera, self.goals))


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The shares of rehearsals, with Wilson's 95 % intervals."""
    declared = [r for r in records if r["declared"]]

    def share(count: int, of: int) -> dict[str, Any]:
        told = wilson(count, of)
        return {"count": count, "of": of, "share": round(told.value, 3),
                "interval_95": [round(told.low, 3), round(told.high, 3)]}

    result = {"reached": share(sum(r["reached"] for r in records), len(records)),
              "declared": share(len(declared), len(records))}
    if declared:
        result["declared_rightly_of_the_declared"] = share(sum(r["declared_rightly"] for r in declared), len(declared))
    return result | {"declared_rightly_of_all": share(sum(r["declared_rightly"] for r in records), len(records)),
                     "median": {key: float(np.median([r[key] for r in records]))
                                for key in ("seconds", "viewpoints", "metres")}}


def rehearsed(out: Path, *, seed: int, board: bool) -> dict[str, dict[str, Any]]:
    """The records that a file holds, by their scenes. What has another seed or other poses is not of these rehearsals,
    and is written over."""
    told = json.loads(out.read_text()) if out.is_file() else {}
    if (told.get("seed"), told.get("board", False)) != (seed, board):
        return {}
    return {record["scene"]: record for record in told["rehearsals"]}


def main(out: Path, count: int = REHEARSALS, *, seed: int = SEED, board: bool = False) -> None:
    """Rehearses in scenes that are chosen evenly, prints a line for each rehearsal, and writes the results after each.
    The summary is that of the chosen scenes. With another `seed` the scenes and the hand are others; with `board` the
    poses come from boards in the image."""
    names = names_of(OBJECTS)
    config = Config().with_values({"scene.objects": OBJECTS, "scene.names": list(names), "bus.kind": "local",
                                   "planner.moved_by": "hand", "seed": seed})
    meshes = tuple(load_mesh(OBJECTS, name) for name in names)
    scenes = generate_split({mesh.name: mesh.size_m for mesh in meshes}, seed=seed, repeats=REPEATS, yaw="fixed")
    records = rehearsed(out, seed=seed, board=board)
    chosen = np.linspace(0, len(scenes) - 1, min(count, len(scenes))).round().astype(int)
    world, pairs, code = World(meshes), agent_pairs("sceneccn", config), commit()
    film = Film((*meshes, *sheets()), RENDER_PX) if board else None
    out.parent.mkdir(parents=True, exist_ok=True)
    for number in map(int, chosen):
        scene = scenes[number]
        if scene.id not in records:
            rehearsal = Rehearsal(world, scene, pairs, names, number, seed=seed, film=film)
            records[scene.id] = {**rehearsal.run(), "commit": code}
            print(json.dumps(records[scene.id]), flush=True)
        told = summary([records[scenes[k].id] for k in chosen if scenes[k].id in records])
        result = {"objects": OBJECTS, "seed": seed, "board": board, "longest_s": LONGEST_S, "chosen": len(chosen),
                  "summary": told, "rehearsals": [*records.values()]}
        out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(told, indent=1))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m saccade.benchmarks.hand", description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="FILE", help="file of the results")
    parser.add_argument("count", type=int, nargs="?", default=REHEARSALS, metavar="N", help="how many rehearsals")
    parser.add_argument("--seed", type=int, default=SEED, help="of the scenes and of the hand")
    parser.add_argument("--board", action="store_true", help="poses from boards in the image of a camera with faults")
    return parser


if __name__ == "__main__":
    given = _parser().parse_args()
    main(given.out, given.count, seed=given.seed, board=given.board)
