"""Saccade from Python: `run` runs an agent, `open` reads a log, `Agent` is an agent within this process.

The keywords of `run` and `Agent` are keys of the configuration: by their last part where that is unique (`objects`,
`seed`, `step_m`), or as a section with a dictionary (`planner={"step_m": 0.03}`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image
from pydantic import BaseModel
from rich.console import Console

from saccade.app.log.episodes import Log
from saccade.app.run.agent import Agent as _Agent
from saccade.app.run.agent import image_of
from saccade.app.run.registry import DEFAULT_WORLD
from saccade.app.run.run import run as _run
from saccade.shared.bus.messages import Result
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError

DEFAULT_AGENT = "sceneccn"
NICKNAMES = {"bus": "bus.kind", "source": "camera.source"}  # what these keywords mean, of what they could mean


@dataclass(frozen=True)
class Run:
    """A run that is over. `path`: its folder, with `run.mcap`, `config.json` and `picture.png`."""

    path: Path
    config: Config
    results: tuple[Result, ...]

    @property
    def result(self) -> Result | None:
        """How the last episode ended; None where nobody judged it, as with a real camera."""
        return self.results[-1] if self.results else None

    def open(self) -> Log:
        """The run's log."""
        return Log(self.path)


def run(*, goal: str | Path | ArrayLike | None = None, agent: str = DEFAULT_AGENT, world: str = DEFAULT_WORLD,
        out: str | Path | None = None, config: str | Path | None = None, show: bool = False, **values: Any) -> Run:
    """Runs an agent as `saccade run` does, and returns when all its episodes are over.

    `goal`: an image to find, a file or an array [480, 480, 3] of bytes, instead of the scene's own. `config`: a file or
    a preset's name, which the other keywords change. `out`: the new folder of the run, `runs/<time>-<seed>` where
    absent. `show` prints the progress. Raises SaccadeError for what the user can mend.
    """
    from saccade.app.look.picture import draw_run  # matplotlib is loaded where it is wanted

    with tempfile.TemporaryDirectory() as folder:
        goal_file = None if goal is None else _file_of(goal, Path(folder))
        keys = keys_of(values) | ({} if goal_file is None else {"scene.goal_image": goal_file})
        resolved = load(None if config is None else Path(config)).with_values(keys)
        finished = _run(resolved, agent=agent, world=world, out=None if out is None else Path(out), plain=True,
                        console=Console(quiet=not show))
    draw_run(finished.folder)
    return Run(finished.folder, finished.config, tuple(finished.results))


def open(path: str | Path) -> Log:
    """The log of a run, by the run's folder or the log itself, of any format that was ever written. It is read lazily
    and once, from start to end. Raises SaccadeError for what is no log."""
    return Log(path)


class Agent(_Agent):
    """An agent within this process, for a robot or a simulator of your own: `action = agent.step(rgb, pose)`.

    `goal`: the image to reach, a file or an array [H, W, 3] of bytes; without one the agent explores. `intrinsics`:
    (fx, fy, cx, cy) of your images, in pixels. Raises SaccadeError for a configuration or a goal that cannot be used.
    """

    def __init__(self, *, goal: str | Path | ArrayLike | None = None, intrinsics: Sequence[float] | None = None,
                 agent: str = DEFAULT_AGENT, config: str | Path | None = None, **values: Any) -> None:
        resolved = load(None if config is None else Path(config)).with_values(keys_of(values))
        super().__init__(resolved, agent=agent, goal=goal, intrinsics=intrinsics)


def keys_of(values: dict[str, Any]) -> dict[str, Any]:
    """Dotted keys of the configuration and their values, from keywords. Raises SaccadeError for a keyword that names no
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
                if found else "is no key of the configuration"))
        keys[found[0]] = list(value) if isinstance(value, tuple) else value
    return keys


@cache
def _leaves() -> dict[str, tuple[str, ...]]:
    """The dotted keys that end in each name."""
    leaves: dict[str, tuple[str, ...]] = {}
    for name, field in Config.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            for key in section.model_fields:
                leaves[key] = (*leaves.get(key, ()), f"{name}.{key}")
        else:
            leaves[name] = (*leaves.get(name, ()), name)
    return leaves


def _file_of(goal: str | Path | ArrayLike, folder: Path) -> Path:
    """The goal as a file, which the simulator reads when it begins."""
    if isinstance(goal, (str, Path)):
        return Path(goal)
    path = folder / "goal.png"
    Image.fromarray(image_of(np.asarray(goal), "goal image")).save(path)
    return path
