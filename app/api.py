"""The Python interface of Saccade: `run` runs an agent, `open` reads a log, `Agent` is an agent within this process.

The keyword arguments of `run` and `Agent` are keys of the configuration. A key is given by its last part where that
part is unique (`objects`, `seed`, `step_m`), or as its section with a dictionary (`planner={"step_m": 0.03}`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image
from pydantic import BaseModel
from rich.console import Console

from saccade.app.log.episodes import Log
from saccade.app.run.agent import Agent as _Agent
from saccade.app.run.agent import image_of
from saccade.app.run.registry import DEFAULT_WORLD, configuration
from saccade.app.run.run import run as _run
from saccade.shared.bus.messages import Result
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError, told

# Several keys end in these words, or the option of the command line has this name: this is the key that is meant
NICKNAMES = {"bus": "bus.kind", "source": "camera.source", "scenes": "scene.file", "rate": "camera.rate_hz",
             "intrinsics": "camera.intrinsics_px"}


@dataclass(frozen=True)
class Run:
    """A finished run. `path` is its folder, which holds `run.mcap`, `config.json` and `picture.png`. `results` says how
    each episode ended; it is empty if nobody judged the run."""

    path: Path
    config: Config
    results: tuple[Result, ...]

    @property
    def result(self) -> Result | None:
        """How the last episode ended. It is None if nobody judged the run, as with a real camera."""
        return self.results[-1] if self.results else None

    def open(self) -> Log:
        """Opens the log of the run."""
        return Log(self.path)


def run(*, goal: str | Path | ArrayLike | None = None, agent: str | None = None, world: str = DEFAULT_WORLD,
        out: str | Path | None = None, config: str | Path | None = None, show: bool = False, **values: Any) -> Run:
    """Runs an agent like the command `saccade run`, and returns when all its episodes are over.

    `goal` is an image to find: a file, or an array [H, W, 3] of uint8; `goal_intrinsics_px` are its (fx, fy, cx, cy).
    Without it the goal comes from the simulator's scene, and with a real camera the agent explores. `config` is a
    configuration file or the name of a preset; the other keywords override its values. `out` is a new folder for the
    run, by default `runs/<time>-<seed>`. Without `agent` it is `sceneccn`, or `open` for objects of your own, for
    photographs, and for any light that is not flat.
    With `show` the progress is printed. Raises SaccadeError if something is wrong that the user can repair.
    """
    from saccade.app.look.picture import draw_run  # here, so that matplotlib is only loaded when it is needed

    with tempfile.TemporaryDirectory() as folder:
        goal_file = None if goal is None else _file_of(goal, Path(folder))
        keys = keys_of(values) | ({} if goal_file is None else {"scene.goal_image": goal_file})
        resolved, name = configuration(_path(config, "config"), keys, agent)
        finished = _run(resolved, agent=name, world=world, out=_path(out, "out"), plain=True,
                        console=Console(quiet=not show))
    draw_run(finished.folder)
    return Run(finished.folder, finished.config, tuple(finished.results))


def open(path: str | Path) -> Log:
    """Opens the log of a run. `path` is the run's folder or the log file itself. Every format that Saccade ever wrote
    can be read. The log is read lazily, from start to end, each time that you iterate it. Raises SaccadeError if the
    file is not a log."""
    if path is None:
        raise SaccadeError("the log is None: give a path as a text or a Path")
    return Log(_path(path, "the log"))


class Agent(_Agent):
    """An agent within this process, for your own robot or simulator: `action = agent.step(rgb, pose)`.

    `goal` is the image to reach: a file, or an array [H, W, 3] of uint8. Without a goal the agent explores.
    `intrinsics` are (fx, fy, cx, cy) of your images, in pixels. Without them, an image of 480x480 pixels is taken as an
    image of the training's camera, and of any other image the central square is used. Without `agent` it is `sceneccn`,
    which knows flat light alone, or `open` for objects of your own: for a real camera, name `open`. Raises
    SaccadeError if the configuration or the goal cannot be used.
    """

    def __init__(self, *, goal: str | Path | ArrayLike | None = None, intrinsics: Sequence[float] | None = None,
                 agent: str | None = None, config: str | Path | None = None, **values: Any) -> None:
        resolved, name = configuration(_path(config, "config"), keys_of(values), agent)
        super().__init__(resolved, agent=name, goal=goal, intrinsics=intrinsics)


def keys_of(values: dict[str, Any]) -> dict[str, Any]:
    """Turns keywords into dotted keys of the configuration with their values. Raises SaccadeError if a keyword names no
    key, or more than one."""
    keys: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict) and name in Config.model_fields:
            keys |= {f"{name}.{key}": inner for key, inner in value.items()}
            continue
        if name in NICKNAMES:
            found: tuple[str, ...] = (NICKNAMES[name],)
        else:
            found = _leaves().get(name, ())
        if len(found) != 1:
            raise SaccadeError(f"keyword {name!r} " + (
                f"could be {' or '.join(found)}: give a section, such as {found[0].split('.')[0]}={{{name!r}: ...}}"
                if found else "is no key of the configuration: the guide's page 'Configuration' lists all keys"))
        keys[found[0]] = list(value) if isinstance(value, tuple) else value
    return keys


@cache
def _leaves() -> dict[str, tuple[str, ...]]:
    """For each last part of a key: all dotted keys that end in it."""
    leaves: dict[str, tuple[str, ...]] = {}
    for name, field in Config.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            for key in section.model_fields:
                leaves[key] = (*leaves.get(key, ()), f"{name}.{key}")
        else:
            leaves[name] = (*leaves.get(name, ()), name)
    return leaves


@overload
def _path(given: None, what: str) -> None: ...
@overload
def _path(given: str | Path, what: str) -> Path: ...
def _path(given: str | Path | None, what: str) -> Path | None:
    """Returns a path. Raises SaccadeError, which begins with `what`, if it is something else."""
    if given is not None and not isinstance(given, (str, PathLike)):
        raise SaccadeError(f"{what} is {told(given)}: give a path as a text or a Path")
    return None if given is None else Path(given)


def _file_of(goal: str | Path | ArrayLike, folder: Path) -> Path:
    """Returns the goal as a file, because the simulator reads a file when it starts. An array is written into
    `folder`."""
    if isinstance(goal, (str, Path)):
        return Path(goal)
    path = folder / "goal.png"
    Image.fromarray(image_of(np.asarray(goal), "goal image")).save(path)
    return path
