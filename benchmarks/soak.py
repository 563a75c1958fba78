"""`python -m saccade.benchmarks.soak [minutes [out.json]]` kills processes of runs at random, and counts what is lost.

The runs follow one another. Every few seconds a process, chosen at random, is killed. The actions of each run must be
those of the same run in one process, to the byte. The exit code is 1 if anything was lost, said twice or done
otherwise.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.table import Table

from saccade.app.log.check import missing
from saccade.app.run.launch import PROCESSES, launch
from saccade.app.run.registry import local_pairs
from saccade.shared.bus.topics import ACTION, STATUS
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.local import run_local

EVERY_S = (4.0, 10.0)  # between two kills
EPISODES = 6
NAMES = ["soup_can", "rice_box"]
FAULTS = ("lost episodes", "lost messages", "messages said twice", "runs with other actions")  # there should be none


def child(name: str) -> int | None:
    """Returns the process id of this process's child that runs the service of that name, or None."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(path.read_text().rsplit(")", 1)[1].split()[1]) != os.getpid():
                continue
            if f"saccade.services.{name}".encode() in (path.parent / "cmdline").read_bytes().split(b"\0"):
                return int(path.parent.name)
        except OSError:
            continue
    return None


def soak(seed: int, folder: Path, counts: Counter, rng: random.Random) -> None:
    """Runs several episodes once, and adds to the counts."""
    config = Config().with_values({"seed": seed, "scene.names": NAMES, "scene.count": EPISODES})
    due_s = time.monotonic() + rng.uniform(*EVERY_S)

    def kill(topic, part, message) -> None:
        nonlocal due_s
        if topic == STATUS and time.monotonic() > due_s:
            due_s = time.monotonic() + rng.uniform(*EVERY_S)
            name = rng.choice([process.name for process in PROCESSES])
            if (process := child(name)) is not None:
                os.kill(process, signal.SIGKILL)
                counts[f"killed: {name}"] += 1

    try:
        results = launch(config, folder / "run", kill, say=lambda text: None)
    except SaccadeError as error:
        print(f"seed {seed}: {error}")
        results = []
    expected: list[bytes] = []
    run_local(local_pairs("sceneccn", config), config.names, "run",
              on_message=lambda t, p, m, _: expected.append(encode(m)) if t == ACTION else None)
    report = missing(folder / "run" / "run.mcap")
    actions = [encode(m) for t, _, m in RunReader(folder / "run" / "run.mcap") if t == ACTION]
    counts["episodes"] += EPISODES
    counts["messages"] += report.messages
    counts["lost episodes"] += EPISODES - len(results)
    counts["lost messages"] += sum(report.lost.values()) + report.count + (report.cut is not None)
    counts["messages said twice"] += report.repeated
    counts["runs with other actions"] += sorted(actions) != sorted(expected)


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there after every run."""
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
    counts: Counter[str] = Counter()
    end_s, seed, rng = time.monotonic() + 60 * minutes, 0, random.Random(0)
    with Console().status("killing") as status:
        while time.monotonic() < end_s:
            with tempfile.TemporaryDirectory() as folder:
                soak(seed, Path(folder), counts, rng)
            seed += 1
            if len(sys.argv) > 2:
                Path(sys.argv[2]).write_text(json.dumps(counts, indent=1, sort_keys=True) + "\n")
            status.update(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))
    table = Table("what", "how many")
    for name, count in sorted(counts.items()):
        table.add_row(name, str(count))
    Console().print(table)
    if any(counts[name] for name in FAULTS):
        sys.exit("saccade: " + ", ".join(f"{name}: {counts[name]}" for name in FAULTS))


if __name__ == "__main__":
    main()
