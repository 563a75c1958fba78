"""What a log says about itself: its origin, its episodes, and how many messages of which kind it holds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from saccade.app.log.cut import Range, range_of
from saccade.app.log.traffic import Keys
from saccade.shared.bus.messages import Result
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import printable
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import AWAITED, FINISHED, RECOVERED

LINE_LIMIT = 20_000
SHORT = 12  # digits of a hash


@dataclass
class LogInfo:
    """An overview of a log. `steps` holds the last step of each episode, and `results` the result of each episode."""

    reader: RunReader
    file_size: int
    keys: Keys = field(default_factory=Keys)
    steps: dict[int, int] = field(default_factory=dict)
    results: dict[int, Result] = field(default_factory=dict)
    refused: int = 0
    kept: Range | None = None

    @property
    def size(self) -> int:
        """Bytes of all messages."""
        return sum(key.size for key in self.keys.found.values())

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        found = self.keys.found.values()
        return (max(key.last_ns for key in found) - min(key.first_ns for key in found)) / 1e9 if found else 0.0


def gather(log: Path) -> LogInfo:
    """Reads a whole log. Raises SaccadeError if the file is not a log, or if it is damaged from its start on."""
    reader = RunReader(log)
    info = LogInfo(reader, log.stat().st_size)
    for topic, part, payload, time_ns in reader.entries():
        if not info.keys.found:
            info.keys = Keys(Sequences(from_start=True, cut=range_of(reader) is not None))
        try:
            message = decode(topic.type, payload)
        except MessageError:
            message = None
            info.refused += 1
        info.keys.take(topic, part, len(payload), time_ns, message)
        if message is None or not topic.in_step:
            continue
        info.steps[message.episode] = max(info.steps.get(message.episode, 0), message.step)
        if isinstance(message, Result):
            info.results[message.episode] = message
    if not info.keys.found:
        reader.require_something()
    info.kept = range_of(reader)
    return info


def lines(info: LogInfo) -> Iterator[str]:
    """Yields everything but the table, line by line."""
    yield from (printable(line, LINE_LIMIT) for line in _lines(info))


def _lines(info: LogInfo) -> Iterator[str]:
    reader, run = info.reader, info.reader.metadata.get("run", {})
    first_ns = min((key.first_ns for key in info.keys.found.values()), default=0)
    began = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(first_ns / 1e9)) if first_ns else "never"
    yield f"log       {reader.path}"
    yield f"run       {run.get('run', 'unknown')}, world {reader.world or 'unknown'}, format {reader.format}"
    yield f"time      {began}, {info.duration_s:.1f} s"
    yield f"origin    seed {run.get('seed', 'unknown')}, commit {run.get('commit') or 'unknown'}"
    for title, name, digits in (("versions", "versions", None), ("weights", "weights_sha256", SHORT)):
        if told := reader.metadata.get(name):
            yield f"{title:9} " + ", ".join(f"{what} {value[:digits]}" for what, value in told.items())
    times = f", {info.size / info.file_size:.1f} times as much as the file" if info.file_size else ""
    yield f"size      {info.file_size:,} bytes, messages {info.size:,} bytes{times}"
    for episode in sorted(info.steps.keys() | info.results.keys()):
        yield f"episode {episode}: {_ending(info.steps.get(episode), info.results.get(episode))}"
    if info.kept is not None:
        yield f"cut to the {info.kept}"
    if told := reader.metadata.get(RECOVERED):
        yield f"recovered from {told.get('log', '')}; lost: {told.get('lost') or 'nothing'}"
    if info.refused:
        yield f"{info.refused} entries are no valid messages"
    if reader.others:
        yield f"{reader.others} entries are under keys that are none of Saccade's"
    if AWAITED in reader.metadata and FINISHED not in reader.metadata:
        yield "the run was not finished: its source did not say that it was over"
    if reader.cut:
        yield reader.cut


def _ending(steps: int | None, result: Result | None) -> str:
    if result is None:
        return f"up to step {steps}, no result"
    reached = "reached" if result.success else "not reached"
    return (f"{result.scene}: {result.target} {reached} in {result.steps} steps; errors: azimuth "
            f"{result.azimuth_error_rad:.3f} rad, elevation {result.elevation_error_rad:.3f} rad, range "
            f"{result.range_error_m:.3f} m")
