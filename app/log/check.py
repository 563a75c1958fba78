"""Whether a log is complete: gaps in the sequence numbers, steps without one of their topics, damage."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from saccade.app.log.cut import Range, range_of
from saccade.shared.bus.messages import Truth
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import RESULT, TOPICS
from saccade.shared.log.reading import RunReader

MOST_STRETCHES = 6  # of steps that are named one by one


@dataclass
class Missing:
    """What a log lacks. `lost`: messages per key, by sequence number; `heartbeats`, of which nobody keeps a copy, apart
    from them and no reason to call a log incomplete. `absent`: (run, episode, step, key) of topics
    that every step should have. `repeated`: messages that are there twice. `cut`: why the file is not whole."""

    messages: int = 0
    repeated: int = 0
    heartbeats: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    absent: list[tuple[str, int, int, str]] = field(default_factory=list)
    refused: int = 0
    cut: str | None = None

    @property
    def complete(self) -> bool:
        """There is something, and nothing is missing."""
        return self.messages > 0 and not (self.lost or self.absent or self.repeated or self.refused or self.cut)

    def lines(self) -> Iterator[str]:
        """What is missing, a line each."""
        if self.cut:
            yield self.cut
        if not self.messages:
            yield "holds no message"
        for key, count in sorted(self.lost.items()):
            yield f"{key}: {count} messages lost, by their sequence numbers"
        for (run, episode, key), group in itertools.groupby(
                sorted(self.absent, key=lambda at: (*at[:2], at[3], at[2])), lambda at: (*at[:2], at[3])):
            yield f"{key}: not there in episode {episode} of {run}, step {abbreviated(at[2] for at in group)}"
        if self.repeated:
            yield f"{self.repeated} messages are there twice"
        if self.refused:
            yield f"{self.refused} entries are no valid messages"


def missing(path: Path) -> Missing:
    """Reads a log and reports gaps. The last step of an episode that is done needs no answer to its frame; of a log
    that was cut out of another only its range is expected. Where nobody waited (`bus.live`) no step needs an answer."""
    report, reader, sequences = Missing(), RunReader(path), None
    steps: dict[tuple[str, int], dict[int, set[str]]] = {}
    held: dict[tuple[str, int], set[str]] = {}  # of each episode: keys that hold for all of it
    done: set[tuple[str, int, int]] = set()
    for topic, part, message in reader:
        sequences = sequences or Sequences(from_start=True, cut=range_of(reader) is not None)
        report.messages += 1
        key = topic.key(reader.world, part)
        lost = sequences.take(topic, part, message)
        report.repeated += lost is None
        report.heartbeats += 0 if topic.in_step else lost or 0
        if topic.latched:
            held.setdefault((message.run, message.episode), set()).add(key)
        elif topic.in_step:
            steps.setdefault((message.run, message.episode), {}).setdefault(message.step, set()).add(key)
            if isinstance(message, Truth) and message.done:
                done.add((message.run, message.episode, message.step))
    live = json.loads(reader.configuration or "{}").get("bus", {}).get("live", False)
    if not live:
        over = {(run, episode) for run, episode, _ in done}
        report.absent = sorted(_absent(steps, done, range_of(reader))
                               + _not_held(steps, held, over, RESULT.key(reader.world)))
    if sequences is not None:
        report.lost = {TOPICS[name].key(reader.world, part): lost for (name, part), lost in sequences.missing.items()}
    report.refused, report.cut = reader.refused, reader.cut
    return report


def _absent(steps: dict[tuple[str, int], dict[int, set[str]]], done: set[tuple[str, int, int]],
            kept: Range | None) -> list[tuple[str, int, int, str]]:
    keys = set().union(*(there for episode in steps.values() for there in episode.values()))
    absent = []
    for episode, there in steps.items():
        last = max(there)
        expected = range(last + 1) if kept is None else range(kept.start, max(kept.end or 0, last) + 1)
        absent += [(*episode, step, key) for step in expected if (*episode, step) not in done
                   for key in keys - there.get(step, set())]
    return absent


def _not_held(steps: dict[tuple[str, int], dict[int, set[str]]], held: dict[tuple[str, int], set[str]],
              over: set[tuple[str, int]], result: str) -> list[tuple[str, int, int, str]]:
    """What one episode has and another lacks; only one that is over has a result."""
    keys = set().union(*held.values())
    return [(*episode, 0, key) for episode in steps for key in keys - held.get(episode, set())
            if key != result or episode in over]


def abbreviated(numbers: Iterable[int]) -> str:
    """Ascending numbers as stretches: 1-3, 7, 9-12."""
    stretches: list[list[int]] = []
    for number in numbers:
        if stretches and number == stretches[-1][-1] + 1:
            stretches[-1][1:] = [number]
        else:
            stretches.append([number])
    told = ["-".join(map(str, stretch)) for stretch in stretches]
    more = len(told) - MOST_STRETCHES
    return ", ".join(told[:MOST_STRETCHES]) + (f" and {more} stretches more" if more > 0 else "")
