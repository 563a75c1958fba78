"""Says where results come from: the machine, and paths that also mean something on another machine."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

from saccade.shared.config import PACKAGE
from saccade.shared.render.opengl import choose_backend

PACKAGES = ("numpy", "torch", "mujoco")


def machine() -> dict[str, str | int]:
    """Describes what may change the last bits of a result, or its running time."""
    return {"processor": _processor(), "cores": os.cpu_count() or 1, "system": platform.system(),
            "python": platform.python_version(), "opengl": choose_backend(),
            **{name: metadata.version(name) for name in PACKAGES}}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def shown(path: Path) -> str:
    """Returns a path relative to the repository if the path is inside it, else the name alone."""
    resolved = path.resolve()
    return str(resolved.relative_to(PACKAGE)) if resolved.is_relative_to(PACKAGE) else resolved.name
