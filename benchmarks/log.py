"""`python -m saccade.benchmarks.log RUN.mcap [out.json]` replays a log as fast as possible without any service.

The speed is compared with that of the mcap library, which reads the same file. The memory is compared with that for a
log ten times as long.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from rich.console import Console
from rich.table import Table

from saccade.services.replayer.core import Keys, Pace, Selection, play
from saccade.shared.bus.topics import STATUS, TOPICS
from saccade.shared.bus.wire import decode, encode
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RunLog

ROUNDS, LONGER = 7, 10


def read_by_mcap(log: Path) -> int:
    """Counts the messages, read by the library alone."""
    with log.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(log_time_order=False))


def replay_into_nothing(log: Path) -> int:
    """Counts the messages, read and played as `saccade replay` does it, without waiting."""
    everything = Selection(tuple(TOPICS.values()))
    return sum(1 for _ in play(RunReader(log, sums=False).entries(), everything, Pace(), Keys(enabled=False)))


def lengthened(log: Path, out: Path) -> None:
    """Writes a log with the log's episodes many times, one after the other."""
    longer = RunLog(out, world="table", configuration="{}")
    for episode in range(LONGER):
        for topic, part, payload, time_ns in RunReader(log).entries():
            if topic == STATUS:
                continue
            fields = vars(decode(topic.type, payload)) | {"episode": episode}
            longer.write(topic, part, encode(topic.type(**fields)), log_time_ns=time_ns)
    longer.close()


def peak_mb(log: Path) -> float:
    """Peak memory of a process that replays the log without any service, in MB."""
    done = subprocess.run([sys.executable, "-m", "saccade.benchmarks.log", "--peak", log], capture_output=True,
                          text=True, check=True)
    return float(done.stdout)


def main() -> None:
    """Prints a table. With a second file's name it writes the numbers there."""
    if sys.argv[1:2] == ["--peak"]:
        replay_into_nothing(Path(sys.argv[2]))
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        return
    log = Path(sys.argv[1])
    seconds: dict[str, list[float]] = {"mcap library": [], "replay into nothing": []}
    for _ in range(ROUNDS):
        for name, work in (("mcap library", read_by_mcap), ("replay into nothing", replay_into_nothing)):
            start_s = time.perf_counter()
            count = work(log)
            seconds[name].append(time.perf_counter() - start_s)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    with tempfile.TemporaryDirectory() as folder:
        lengthened(log, Path(folder) / "long.mcap")
        memory = {"the log": peak_mb(log), f"{LONGER} times as long": peak_mb(Path(folder) / "long.mcap")}
    table = Table("what", "value", "ratio")
    for name, value in medians.items():
        table.add_row(f"{name}: {count} messages, messages per s", f"{count / value:.0f}",
                      f"{medians['mcap library'] / value:.2f} of the library")
    for name, value in memory.items():
        table.add_row(f"peak memory, {name}, MB", f"{value:.0f}", f"{value / memory['the log']:.2f} of the log's")
    Console().print(table)
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_text(json.dumps({"seconds": seconds, "memory_mb": memory}, indent=1) + "\n")


if __name__ == "__main__":
    main()
