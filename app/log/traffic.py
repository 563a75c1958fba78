"""Counts what arrived on each key of a log or a bus: how much, how often, for which steps, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass, field

from rich.table import Table

from saccade.shared.bus.messages import Message
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import Stamp

Step = tuple[int, int]  # episode and step


@dataclass
class KeyInfo:
    """The messages of one key: how many there are, their bytes, how many are missing, and the times (ns) and steps of
    the first and the last. `first` and `last` are None if no message belongs to a step."""

    messages: int = 0
    size: int = 0
    gaps: int = 0
    first_ns: int = 0
    last_ns: int = 0
    first: Step | None = None
    last: Step | None = None

    def take(self, size: int, time_ns: int) -> None:
        """Counts one more message."""
        self.first_ns = time_ns if not self.messages else min(self.first_ns, time_ns)
        self.last_ns = max(self.last_ns, time_ns)
        self.messages, self.size = self.messages + 1, self.size + size

    def belongs_to(self, step: Step) -> None:
        """Notes the step of a message."""
        self.first, self.last = min(self.first or step, step), max(self.last or step, step)

    @property
    def rate_hz(self) -> float | None:
        """Messages per second between the first and the last. None if no time has passed between them."""
        span_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * 1e9 / span_ns if span_ns > 0 else None

    @property
    def steps(self) -> str:
        """The first and the last step as text, each with its episode."""
        return " to ".join(dict.fromkeys(f"{at[0]}:{at[1]}" for at in (self.first, self.last) if at is not None))


@dataclass
class Keys:
    """All keys on which something arrived, with their counts."""

    sequences: Sequences = field(default_factory=Sequences)
    found: dict[tuple[Topic, str | None], KeyInfo] = field(default_factory=dict)

    def take(self, topic: Topic, part: str | None, size: int, time_ns: int, said: Message | Stamp | None) -> None:
        """Counts one message of `size` bytes. `said` is the message or its stamp, or None if it is not valid."""
        info = self.found.setdefault((topic, part), KeyInfo())
        info.take(size, time_ns)
        if said is None:
            return
        missing = self.sequences.take(topic, part, said) or 0
        if topic.in_step:
            info.belongs_to((said.episode, said.step))
        else:
            info.gaps += missing

    def table(self, world: str) -> Table:
        """Returns a table with a row for each key."""
        result, missing = Table(), self.sequences.missing  # a status counts in `gaps`
        result.add_column("key", overflow="fold")
        result.add_column("message", no_wrap=True)
        for header in ("messages", "bytes", "per\nsecond", "episode:\nstep", "gaps"):  # narrow: the key needs room
            result.add_column(header, justify="right", no_wrap=True)
        for (topic, part), info in sorted(self.found.items(), key=lambda item: item[0][0].key(world, item[0][1])):
            rate = "" if info.rate_hz is None else f"{info.rate_hz:.2f}"
            result.add_row(topic.key(world, part), topic.type.__name__, f"{info.messages:,}", f"{info.size:,}", rate,
                           info.steps, str(info.gaps + missing.get((topic.name, part), 0)))
        return result
