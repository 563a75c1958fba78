"""Suites: named sets of scenes on which results are reported. All but the paper's own are drawn from seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from saccade.services.simulator.scenes import (
    PAPER_SCENES,
    Scene,
    Sizes,
    generate_split,
    room_scenes,
    save_scenes,
)
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.render.objects import load_mesh, names_in_use

Yaw = Literal["random", "fixed"]

YAW_SEED, LOOKS_SEED = 31_415_000, 16_180_000
LOOKS_REPEATS = 4
MOST = 5  # objects on a table, as in the paper; a set may have more
IN_ANY_LIGHT = {"simulator.look": "random", "simulator.goal_look": "random"}
DEV_SEEDS: dict[Yaw, int] = {"fixed": 57_721_000, "random": 57_722_000}  # of the halves without and with turned objects
DEV_REPEATS = 2  # repeats in each half


@dataclass(frozen=True)
class Suite:
    """Scenes that `draw(sizes, seed of the run)` makes, or the scenes of a file, which belong to one object set.
    `values` are keys of the configuration that belong to the suite, too."""

    draw: Callable[[Sizes, int], list[Scene]] | None = None
    file: Path | None = None
    objects: str | None = None
    values: Mapping[str, str] = field(default_factory=dict)


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
}


def default_suite(objects: str) -> str:
    """The paper's scenes for the paper's objects. For other objects, scenes that are drawn by the same rules."""
    return "paper-500" if objects == SUITES["paper-500"].objects else "paper-like"


def suite_file(name: str, config: Config, beside: Path) -> Path:
    """Returns the file with a suite's scenes: its own file, or `beside`, which is then written here.

    Raises SaccadeError if the suite is unknown, or if it is not of the configured objects.
    """
    if name not in SUITES:
        raise SaccadeError(f"suite {name!r} is unknown: choose from {', '.join(SUITES)}")
    suite, scene = SUITES[name], config.scene
    if suite.objects not in (None, scene.objects):
        others = ", ".join(other for other, s in SUITES.items() if s.objects is None)
        raise SaccadeError(f"suite {name!r} is of the objects {suite.objects!r}: add `--objects {suite.objects}`, or "
                           f"choose from {others}")
    if suite.file is not None:
        return suite.file
    sizes = {each: load_mesh(scene.objects, each).size_m for each in names_in_use(scene)}
    assert suite.draw is not None  # a suite without a file has `draw`
    save_scenes(beside, suite.draw(sizes, config.seed))
    return beside
