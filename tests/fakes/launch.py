"""python -m tests.fakes.launch RUN_DIR EPISODES STEPS [WISH]: the fakes between the real router and recorder."""

from __future__ import annotations

import sys
from pathlib import Path

from deploy.launch import PROCESSES, launch
from deploy.supervisor import Process
from shared.config import Config
from shared.errors import SaccadeError

REAL = ("router", "recorder")
FAKES = tuple(p if p.name in REAL else Process(p.name, f"tests.fakes.{p.name}") for p in PROCESSES)
PARTS = ("mug", "can")


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
