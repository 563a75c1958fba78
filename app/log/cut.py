"""Cuts some steps of an episode out of a log, as a log of their own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from saccade.app.log.source import whole
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import Recorded, RunReader
from saccade.shared.log.recording import AWAITED, CUT, ENDED_EARLY, FINISHED, LOG, RecordingStopped, RunLog

Times = dict[int, tuple[int, int]]  # by step: first and last time (ns)
Steps = dict[int, Times]  # by episode

NOT_OF_A_PART = (LOG, ENDED_EARLY, AWAITED, FINISHED)  # metadata about the whole log


@dataclass(frozen=True)
class Range:
    """Some steps of an episode, from `start` to `end` inclusive. `episode` is None for every episode, `end` is None for
    the last step."""

    episode: int | None
    start: int
    end: int | None

    def __str__(self) -> str:
        steps = f"steps {self.start} to {self.end}" if self.end is not None else f"steps from {self.start} on"
        return steps + (f" of episode {self.episode}" if self.episode is not None else "")


def range_of(reader: RunReader) -> Range | None:
    """The steps to which a log was cut, or from which it was recorded. None for a whole log. It is known when the first
    entry has been read. Raises SaccadeError if the log was cut but does not say to which steps."""
    told = reader.metadata.get(CUT)
    if not told:
        return None
    try:
        episode, end = (int(told[name]) if name in told else None for name in ("episode", "end"))
        return Range(episode, int(told["start"]), end)
    except (KeyError, ValueError) as error:
        raise SaccadeError(f"log {reader.path} was cut, but does not say to which steps") from error


def cut(log: Path, out: Path, *, episode: int | None = None, start: int = 0, end: int | None = None) -> Range:
    """Writes the messages of these steps of an episode (by default the last one) into the new log `out`, in the present
    format. Returns the steps.

    The new log also holds the latched messages up to then, and the status messages of that time. Raises SaccadeError if
    nothing is left, if `log` cannot be read, or if `out` exists or cannot be written.
    """
    kept, times = _find(log, episode, start, end)
    reader, target = RunReader(log), None
    with whole(out) as partial:
        try:
            for entry in reader.entries():
                if target is None:
                    metadata = {name: told for name, told in reader.metadata.items() if name not in NOT_OF_A_PART}
                    metadata[CUT] = {name: str(number) for name, number in vars(kept).items()}
                    target = RunLog(partial, world=reader.world, configuration=reader.configuration or "{}",
                                    metadata=metadata)
                sequence = _kept(entry, kept, times)
                if sequence is not None:
                    target.write(entry.topic, entry.part, entry.payload, sequence=sequence,
                                 log_time_ns=entry.log_time_ns)
            if target is not None:
                target.close()
        except RecordingStopped as error:
            raise SaccadeError(f"{out} cannot be written: {error.__cause__ or error}") from error
    return kept


def require_steps(log: Path, episode: int | None, start: int, end: int | None) -> None:
    """Raises SaccadeError if the log holds none of these steps of an episode, or of any episode."""
    there = _steps(RunReader(log))
    for steps in there.values() if episode is None else ():
        if any(start <= step and (end is None or step <= end) for step in steps):
            return
    _chosen(log, there, episode, start, end)


def _find(log: Path, episode: int | None, start: int, end: int | None) -> tuple[Range, tuple[int, int]]:
    """Returns which of the given steps the log holds, and the times (ns) between which they were recorded. Raises
    SaccadeError if it holds none."""
    reader = RunReader(log)
    there = _steps(reader)
    episode, chosen = _chosen(log, there, episode, start, end)
    before = range_of(reader) or Range(episode, 0, 0)
    last = max(*there[episode], before.end or 0)
    kept = Range(episode, max(start, before.start), last if end is None else min(end, last))
    return kept, (min(first for first, _ in chosen.values()), max(last for _, last in chosen.values()))


def _steps(reader: RunReader) -> Steps:
    """The steps of each episode of a log, with the first and the last time at which they were recorded."""
    there: Steps = {}
    for entry in reader.entries():
        if entry.topic.in_step and not entry.topic.latched:
            try:
                message = decode(entry.topic.type, entry.payload)
            except MessageError:
                continue
            steps, now = there.setdefault(message.episode, {}), entry.log_time_ns
            first, last = steps.get(message.step, (now, now))
            steps[message.step] = min(first, now), max(last, now)
    return there


def _chosen(log: Path, there: Steps, episode: int | None, start: int, end: int | None) -> tuple[int, Times]:
    """Returns the episode, by default the last one, and those of its steps that were asked for. Raises SaccadeError if
    there are none."""
    if not there:
        raise SaccadeError(f"log {log} holds no steps to cut")
    episode = max(there) if episode is None else episode
    if episode not in there:
        raise SaccadeError(f"log {log} has no episode {episode}: choose from {min(there)} to {max(there)}")
    steps = there[episode]
    chosen = {step: times for step, times in steps.items() if start <= step and (end is None or step <= end)}
    if not chosen:
        asked = f"from {start} on" if end is None else f"{start} to {end}"
        raise SaccadeError(f"episode {episode} of {log} has the steps {min(steps)} to {max(steps)}: none of {asked}")
    return episode, chosen


def _kept(entry: Recorded, kept: Range, times: tuple[int, int]) -> int | None:
    """Returns the sequence number of an entry that belongs to the cut, and None for any other entry."""
    try:
        message = decode(entry.topic.type, entry.payload)
    except MessageError:
        return None
    if not entry.topic.in_step:
        return message.seq if times[0] <= entry.log_time_ns <= times[1] else None
    first = 0 if entry.topic.latched else kept.start
    if message.episode != kept.episode or message.step < first or (kept.end is not None and message.step > kept.end):
        return None
    return message.seq
