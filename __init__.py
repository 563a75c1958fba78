"""Saccade: an active-vision agent made of independent services.

`saccade.run(objects="pantry", seed=4)` runs the agent. `saccade.open(path)` reads the log of a run. `saccade.Agent` is
an agent within this process, for a robot or a simulator of your own.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from saccade.app.api import Agent, Run, open, run
    from saccade.app.log.episodes import Episode, Log, Step
    from saccade.shared.config import Config
    from saccade.shared.errors import SaccadeError
    from saccade.shared.world.task import apply_action

    __version__: str

__all__ = ["Agent", "Config", "Episode", "Log", "Run", "SaccadeError", "Step", "apply_action", "open", "run"]

_HOMES = {
    "Agent": "saccade.app.api", "Run": "saccade.app.api", "open": "saccade.app.api", "run": "saccade.app.api",
    "Episode": "saccade.app.log.episodes", "Log": "saccade.app.log.episodes", "Step": "saccade.app.log.episodes",
    "Config": "saccade.shared.config", "SaccadeError": "saccade.shared.errors",
    "apply_action": "saccade.shared.world.task",
}


def __getattr__(name: str) -> Any:
    """Loads a name when it is asked for. The process of a service also imports this package, and needs none of these
    names."""
    if name == "__version__":
        from importlib.metadata import version

        return version("saccade")
    if name not in _HOMES:
        raise AttributeError(f"module 'saccade' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
