"""python -m saccade.tests.fakes.launch RUN_DIR EPISODES STEPS [WISH]: fakes between real router and recorder."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from saccade.app.run.launch import PROCESSES, launch
from saccade.app.run.supervisor import Process
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError

REAL = ("router", "recorder")
FAKES = tuple(p if p.name in REAL else Process(p.name, f"saccade.tests.fakes.{p.name}") for p in PROCESSES)
PARTS = ("mug", "can")


def processes_of(run_dir: Path) -> dict[str, int]:
    """Process ids of the services that run on this folder's configuration, by name."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            words = path.read_text(errors="replace").split("\0")
            if f"{run_dir}/config.json" in words and "-m" in words:
                found[words[words.index("-m") + 1].rsplit(".", 1)[-1]] = int(path.parent.name)
    return found


def configuration(episodes: int, steps: int, wish: str = "") -> Config:
    """A run of the fakes; `wish` asks one of them to misbehave."""
    return Config().with_values({"scene.names": list(PARTS), "scene.count": episodes, "simulator.max_steps": steps,
                                 "scene.scene": wish or None, "seed": 5})


if __name__ == "__main__":
    try:
        config = configuration(int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:])
        print(len(launch(config, Path(sys.argv[1]), None, FAKES)))
    except SaccadeError as error:
        sys.exit(f"saccade: {error}")
