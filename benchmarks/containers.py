"""`python -m benchmarks.containers [out.json]`: steps per second of `docker compose up` with one, two and three
replicas of perception, and with and without shared memory between the containers; in turn, round after round."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from shared.config import REPOSITORY
from shared.reading import RunReader
from shared.topics import STATUS, TRUTH

ROUNDS, SCENES = 3, 8
REPLICAS = (1, 2, 3)
PROJECT = f"saccade-bench-{os.getpid()}"


def compose(*arguments: str) -> None:
    environment = {**os.environ, "SACCADE_COUNT": str(SCENES), "SACCADE_SEED": "3", "SACCADE_PORT": "0"}
    subprocess.run(["docker", "compose", "-p", PROJECT, *arguments], cwd=REPOSITORY, env=environment, check=True,
                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def run(replicas: int, files: tuple[str, ...] = ()) -> tuple[float, float]:
    """Steps per second, and milliseconds of perception per step (the median over all replicas)."""
    chosen = [argument for name in files for argument in ("-f", name)]
    compose(*chosen, "up", "--scale", f"perception={replicas}")
    compose(*chosen, "down", "--volumes")
    truths_ns = []
    for topic, _, _, time_ns in (reader := RunReader(REPOSITORY / "runs" / "latest" / "run.mcap")).entries():
        if topic == TRUTH:
            truths_ns.append(time_ns)
    milliseconds = [m.milliseconds for topic, part, m in reader if topic == STATUS and part == "perception"]
    return (len(truths_ns) - 1) / (truths_ns[-1] - truths_ns[0]) * 1e9, float(np.median([m for m in milliseconds if m]))


def without_shared_memory(folder: Path) -> str:
    """An override that gives every container a /dev/shm of its own."""
    services = yaml.safe_load((REPOSITORY / "compose.yaml").read_text())["services"]
    mounts = {name: [volume for volume in service["volumes"] if "bus-memory" not in volume]
              for name, service in services.items() if any("bus-memory" in v for v in service.get("volumes", ()))}
    lines = [f"  {name}:\n    volumes: !override {json.dumps(volumes)}" for name, volumes in mounts.items()]
    (folder / "alone.yaml").write_text("services:\n" + "\n".join(lines) + "\n")
    return str(folder / "alone.yaml")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        alone = ("compose.yaml", without_shared_memory(Path(folder)))
        ways = [(f"{n} x perception", partial(run, n)) for n in REPLICAS]
        ways.append(("1 x perception, no shared memory", partial(run, 1, alone)))
        compose("build")
        found = {name: [] for name, _ in ways}
        for number in range(ROUNDS):
            for name, measure in ways[number % len(ways):] + ways[:number % len(ways)]:
                found[name].append(measure())
    rates = {name: float(np.median([rate for rate, _ in values])) for name, values in found.items()}
    spent_ms = {name: float(np.median([ms for _, ms in values])) for name, values in found.items()}
    first = ways[0][0]
    table = Table("way", "steps per s", "of the first", "perception, ms a step", "projected with a core each")
    for name, rate in rates.items():
        projected = 1 / (1 / rates[first] - (spent_ms[first] - spent_ms[name]) / 1e3)
        table.add_row(name, f"{rate:.2f}", f"{rate / rates[first]:.3f}", f"{spent_ms[name]:.1f}",
                      f"{projected / rates[first]:.2f}")
    Console().print(table)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
