"""`python -m saccade.benchmarks.containers [out.json]` measures the steps per second of `docker compose up`.

It compares one, two and three replicas of perception, and shared memory between the containers with none. The ways take
turns, round after round.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from saccade.benchmarks.rounds import in_turn
from saccade.services.perception.core import SceneCCN
from saccade.shared.bus.topics import TRUTH
from saccade.shared.config import PACKAGE, WEIGHTS
from saccade.shared.log.reading import RunReader
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import names_of
from saccade.shared.world.geometry import INTRINSICS_PX

ROUNDS, SCENES, REPEATS = 3, 8, 60
REPLICAS = (1, 2, 3)
PROJECT = f"saccade-bench-{os.getpid()}"


def compose(*arguments: str) -> None:
    """Runs a command of `docker compose` in a project of its own."""
    environment = {**os.environ, "SACCADE_COUNT": str(SCENES), "SACCADE_SEED": "3", "SACCADE_PORT": "0",
                   "SACCADE_VIEW_S": "0"}
    subprocess.run(["docker", "compose", "-p", PROJECT, *arguments], cwd=PACKAGE, env=environment, check=True,
                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def run(replicas: int, files: tuple[str, ...] = ()) -> float:
    """Runs the scenes once, and returns the steps per second."""
    chosen = [argument for name in files for argument in ("-f", name)]
    compose(*chosen, "up", "--scale", f"perception={replicas}")
    compose(*chosen, "down", "--volumes")
    entries = RunReader(PACKAGE / "runs" / "latest" / "run.mcap").entries()
    truths_ns = [entry.log_time_ns for entry in entries if entry.topic == TRUTH]
    return (len(truths_ns) - 1) / (truths_ns[-1] - truths_ns[0]) * 1e9


def perception_ms(objects: int) -> float:
    """Median milliseconds of perception for one image and so many objects, with a core to itself."""
    import torch

    torch.set_num_threads(1)
    names, image = names_of("pantry")[:objects], np.random.default_rng(0).integers(0, 255, (480, 480, 3), np.uint8)
    networks, spent_ms = SceneCCN(Weights(WEIGHTS / "pantry"), names), []
    for _ in range(REPEATS):
        start = time.perf_counter()
        networks.see(image, INTRINSICS_PX, (0.0, 0.0, 1.0))
        spent_ms.append((time.perf_counter() - start) * 1e3)
    return float(np.median(spent_ms))


def without_shared_memory(folder: Path) -> str:
    """Writes a compose file that gives every container a /dev/shm of its own. Returns its path."""
    services = yaml.safe_load((PACKAGE / "compose.yaml").read_text())["services"]
    mounts = {name: [volume for volume in service["volumes"] if "bus-memory" not in volume]
              for name, service in services.items() if any("bus-memory" in v for v in service.get("volumes", ()))}
    lines = [f"  {name}:\n    volumes: !override {json.dumps(volumes)}" for name, volumes in mounts.items()]
    (folder / "alone.yaml").write_text("services:\n" + "\n".join(lines) + "\n")
    return str(folder / "alone.yaml")


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    with tempfile.TemporaryDirectory() as folder:
        alone = ("compose.yaml", without_shared_memory(Path(folder)))
        ways = {f"{n} x perception": partial(run, n) for n in REPLICAS}
        ways["1 x perception, no shared memory"] = partial(run, 1, alone)
        compose("build")
        found = in_turn(ways, ROUNDS)
    rates = {name: float(np.median(values)) for name, values in found.items()}
    first, objects = next(iter(ways)), len(names_of("pantry"))
    alone_ms = {k: perception_ms(k) for k in sorted({math.ceil(objects / n) for n in REPLICAS})}
    table = Table("way", "steps per s", "of the first", "objects each", "perception, ms", "projected: a core each")
    for (name, rate), replicas in zip(rates.items(), (*REPLICAS, 1), strict=True):
        share = math.ceil(objects / replicas)
        projected = 1 / (1 / rates[first] - (alone_ms[objects] - alone_ms[share]) / 1e3)
        table.add_row(name, f"{rate:.2f}", f"{rate / rates[first]:.3f}", str(share), f"{alone_ms[share]:.1f}",
                      f"{projected / rates[first]:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
