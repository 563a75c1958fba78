"""`python -m saccade.benchmarks.soak [kills [out.json]]` kills processes of runs at random, and counts what is lost.

The runs follow one another until so many processes were killed (default: 200). Every few seconds it is the turn of one,
after a step; some are killed while another one is still coming back. The router, the recorder and the services all have
their turn before one of them has its next, and none is killed so often that the run has to give it up. The actions of
each run must be those of the same run in one process, to the byte. What `out.json` counted already counts on, and a run
in which something was lost is kept in a folder beside it. The exit code is 1 if anything was lost, said twice or done
otherwise.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from saccade.app.log.check import missing
from saccade.app.run.launch import PROCESSES, launch
from saccade.app.run.registry import local_pairs
from saccade.app.run.supervisor import RESTARTS, RESTARTS_S
from saccade.shared.bus.topics import ACTION, STATUS, Topic
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.log.provenance import commit
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.local import run_local

EVERY_S = (0.3, 3.0)  # between two kills
AGAIN = 0.25  # share of the kills that do not wait for a step to be done after the one before
EPISODES = 12  # of a run
NAMES = ["soup_can", "rice_box"]
KILLED = "killed: "
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


def victims(rng: random.Random) -> Iterator[str]:
    """Yields the names of processes for ever, all of them in a new order in each round."""
    names = [process.name for process in PROCESSES]
    while True:
        yield from rng.sample(names, len(names))


def soak(seed: int, folder: Path, counts: Counter, rng: random.Random, turn: Iterator[str]) -> None:
    """Runs several episodes once, and adds to the counts."""
    config = Config().with_values({"seed": seed, "scene.names": NAMES, "scene.count": EPISODES})
    due_s = time.monotonic() + rng.uniform(*EVERY_S)
    heard: tuple[Topic, ...] = (ACTION,)
    killed_s: dict[str, deque[float]] = defaultdict(lambda: deque([-RESTARTS_S] * RESTARTS, RESTARTS))

    def kill(topic, part, message) -> None:
        nonlocal due_s, heard
        if topic in heard and time.monotonic() > due_s:
            due_s = time.monotonic() + rng.uniform(*EVERY_S)
            heard = (ACTION, STATUS) if rng.random() < AGAIN else (ACTION,)
            name = next(name for name in turn if time.monotonic() - killed_s[name][0] > RESTARTS_S)
            if (process := child(name)) is not None:
                os.kill(process, signal.SIGKILL)
                killed_s[name].append(time.monotonic())
                counts[KILLED + name] += 1

    try:
        results = launch(config, folder / "run", kill, say=lambda text: None, topics=(ACTION, STATUS))
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


def killed(counts: Counter[str]) -> int:
    """How many processes were killed so far."""
    return sum(count for name, count in counts.items() if name.startswith(KILLED))


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there after every run."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    out = Path(sys.argv[2]) if len(sys.argv) > 2 else None
    counts = Counter(json.loads(out.read_text())["counts"] if out is not None and out.is_file() else {})
    rng = random.Random(counts["runs"])
    turn = victims(rng)
    with Console().status("killing") as status:
        while killed(counts) < kills:
            faults = [counts[name] for name in FAULTS]
            with tempfile.TemporaryDirectory() as folder:
                soak(counts["runs"], Path(folder), counts, rng, turn)
                if out is not None and faults != [counts[name] for name in FAULTS]:
                    shutil.copytree(folder, out.with_suffix("") / str(counts["runs"]), dirs_exist_ok=True)
            counts["runs"] += 1
            if out is not None:
                known = {"commit": commit(), "counts": counts}
                out.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
            status.update(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))
    table = Table("what", "how many")
    for name, count in sorted(counts.items()):
        table.add_row(name, str(count))
    Console().print(table)
    if any(counts[name] for name in FAULTS):
        sys.exit("saccade: " + ", ".join(f"{name}: {counts[name]}" for name in FAULTS))


if __name__ == "__main__":
    main()
