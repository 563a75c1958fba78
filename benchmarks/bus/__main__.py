"""`python -m saccade.benchmarks.bus [out.json]` sends camera images (480x480) as encoded Frames from process to
process.

Every contender gets the same bytes at the same pace. The contenders take turns, round after round, in fresh processes.
The table gives p50 and p99 of the one-way latency, and p50 as a ratio to a plain copy of these bytes and to our bus.
`pip install saccade[bench]` installs the others. A contender that is missing or fails is in the table with the reason.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from saccade.benchmarks.bus.contenders import CONTENDERS, OURS
from saccade.benchmarks.bus.measure import CODED, ENCODED, KINDS, Plan, frames, within_one_process
from saccade.benchmarks.bus.peer import Contender, run_round
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError

YARDSTICKS = {ENCODED: "memory copy", CODED: "no bus"}
NOT_INSTALLED = "not installed: pip install saccade[bench]"
PACKAGES = ("eclipse-zenoh", "pyzmq", "dora-rs", "pyarrow", "msgpack", "numpy")

# By transport and payload, for each round: nanoseconds [messages]
Latencies = Mapping[tuple[str, str], list[np.ndarray]]


def measure(plan: Plan, contenders: Iterable[Contender]) -> dict[str, Any]:
    """Measures all contenders, round after round. A contender that fails is not tried again."""
    contenders = list(contenders)
    notes = {c.name: NOT_INSTALLED for c in contenders if not all(find_spec(module) for module in c.modules)}
    rounds: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    for _ in track(range(plan.rounds), "rounds", console=Console(stderr=True)):
        for kind in KINDS:
            rounds[YARDSTICKS[kind], kind].append(within_one_process(plan, kind)[plan.warmup:])
            for contender in contenders:
                if contender.name in notes:
                    continue
                try:
                    rounds[contender.name, kind].append(run_round(contender, plan, kind)[plan.warmup:])
                except SaccadeError as error:
                    notes[contender.name] = str(error)
    rows = [_row(name, kind, rounds) for kind in KINDS for name in (YARDSTICKS[kind], *(c.name for c in contenders))
            if name not in notes]
    rows += [{"transport": name, "note": note} for name, note in notes.items()]
    return {"plan": dataclasses.asdict(plan), "payload_bytes": len(encode(frames()[0])), "machine": _machine(),
            "rows": rows}


def _row(name: str, kind: str, rounds: Latencies) -> dict[str, Any]:
    """Percentiles over all rounds (milliseconds), and the median of each round."""

    def p50(key: tuple[str, str]) -> float:
        return float(np.median(np.concatenate(rounds[key]))) / 1e6

    median, ours = p50((name, kind)), p50((OURS, kind)) if rounds.get((OURS, kind)) else None
    times = np.concatenate(rounds[name, kind])
    return {"transport": name, "payload": kind, "messages": len(times), "p50_ms": median,
            "p99_ms": float(np.percentile(times, 99)) / 1e6,
            "of_memory_copy": median / p50((YARDSTICKS[ENCODED], ENCODED)), "of_ours": median / ours if ours else None,
            "rounds_p50_ms": [float(np.median(t)) / 1e6 for t in rounds[name, kind]]}


def _machine() -> dict[str, Any]:
    versions: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return {"platform": platform.platform(), "python": platform.python_version(), "cores": os.cpu_count(),
            "load": os.getloadavg()[0], "versions": versions}


def table(results: Mapping[str, Any]) -> Table:
    """Returns the table for the terminal."""
    drawn = Table("transport", "payload", title=f"{results['payload_bytes'] / 1e3:.0f} kB, one way")
    for heading in ("p50 ms", "p99 ms", "of a copy", "of ours"):
        drawn.add_column(heading, justify="right")
    section = None
    for row in results["rows"]:
        if row.get("payload") != section:
            drawn.add_section()
            section = row.get("payload")
        if "note" in row:
            drawn.add_row(escape(row["transport"]), escape(row["note"]))
        else:
            ours = "" if row["of_ours"] is None else f"{row['of_ours']:.2f}"
            drawn.add_row(escape(row["transport"]), row["payload"], f"{row['p50_ms']:.3f}", f"{row['p99_ms']:.3f}",
                          f"{row['of_memory_copy']:.1f}", ours)
    return drawn


def main() -> None:
    """Prints the table. With a file's name it writes the results there."""
    results = measure(Plan(), CONTENDERS.values())
    Console().print(table(results))
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
