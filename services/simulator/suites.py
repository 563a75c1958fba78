"""Suites: named sets of scenes on which results are reported. All but the paper's own are drawn from seeds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from saccade.services.simulator.scene import Scene
from saccade.services.simulator.scenes import PAPER_SCENES, Sizes, generate_split, load_scenes, room_scenes
from saccade.services.simulator.tables import LYING, TABLES, draw_tables
from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh import Mesh

Yaw = Literal["random", "fixed"]

YAW_SEED, LOOKS_SEED = 31_415_000, 16_180_000
LOOKS_REPEATS = 4
MOST = 5  # objects on a table, as in the paper; a set may have more
IN_ANY_LIGHT = {"simulator.look": "random", "simulator.goal_look": "random"}
DEV_SEEDS: dict[Yaw, int] = {"fixed": 57_721_000, "random": 57_722_000}  # of the halves without and with turned objects
DEV_REPEATS = 2  # repeats in each half


@dataclass(frozen=True)
class Suite:
    """Scenes that `draw(sizes, seed of the run)` makes, or `place(meshes, seed of the run)`, which needs the objects'
    shapes, or the scenes of a file, which belong to one object set. `values` are keys of the configuration that belong
    to the suite, too. `lying` says that its objects may lie on their sides."""

    draw: Callable[[Sizes, int], list[Scene]] | None = None
    place: Callable[[Mapping[str, Mesh], int], list[Scene]] | None = None
    file: Path | None = None
    objects: str | None = None
    values: Mapping[str, str] = field(default_factory=dict)
    lying: bool = False

    def scenes(self, meshes: Mapping[str, Mesh], seed: int) -> list[Scene]:
        """The scenes for these objects. Raises SaccadeError if they do not fit on the table, or if the file is of
        others."""
        if self.place is not None:
            return self.place(meshes, seed)
        if self.draw is not None:
            return self.draw({name: mesh.size_m for name, mesh in meshes.items()}, seed)
        assert self.file is not None  # a suite has one of the three
        return load_scenes(self.file, tuple(meshes))


def _split(sizes: Sizes, seed: int, yaw: Yaw, repeats: int = 20) -> list[Scene]:
    return generate_split(sizes, seed=seed, counts=range(1, min(len(sizes), MOST) + 1), repeats=repeats, yaw=yaw)


def _dev(sizes: Sizes, _seed: int) -> list[Scene]:
    """The scenes for tuning. No other scenes are used for it."""
    return [scene for yaw, seed in DEV_SEEDS.items() for scene in _split(sizes, seed, yaw, DEV_REPEATS)]


SUITES = {
    "paper-500": Suite(file=PAPER_SCENES, objects="ycb"),
    "yaw-500": Suite(lambda sizes, _seed: _split(sizes, YAW_SEED, "random")),
    "lexa-room": Suite(lambda sizes, _seed: room_scenes(sizes)),
    "looks": Suite(lambda sizes, _seed: _split(sizes, LOOKS_SEED, "random", LOOKS_REPEATS), values=IN_ANY_LIGHT),
    "dev": Suite(_dev),
    "paper-like": Suite(lambda sizes, seed: _split(sizes, seed, "fixed")),
    "paper-like-yaw": Suite(lambda sizes, seed: _split(sizes, seed, "random")),
} | {kind: Suite(place=functools.partial(draw_tables, kind), lying=kind in LYING) for kind in TABLES}


def suite_of(name: str, objects: str) -> Suite:
    """The suite of that name. Raises SaccadeError if it is unknown, or if it is of other objects."""
    if name not in SUITES:
        raise SaccadeError(f"suite {name!r} is unknown: choose from {', '.join(SUITES)}")
    suite = SUITES[name]
    if suite.objects not in (None, objects):
        others = ", ".join(other for other, s in SUITES.items() if s.objects is None)
        raise SaccadeError(f"suite {name!r} is of the objects {suite.objects!r}: add `--objects {suite.objects}`, or "
                           f"choose from {others}")
    return suite
