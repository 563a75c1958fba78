"""Checks whether a log is complete. It finds gaps in the sequence numbers, steps without one of their topics, and
damage."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from saccade.app.log.cut import Range, range_of
from saccade.app.log.source import setting_of
from saccade.shared.bus.messages import Message, Truth
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import RESULT, TOPICS, Topic
from saccade.shared.bus.wire import Stamp
from saccade.shared.errors import printable
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import AWAITED, FINISHED

MOST_STRETCHES = 6  # stretches of steps that are named one by one
MOST_ABSENT = 10_000  # stretches that are looked for; each costs memory, and steps may have any numbers
LINE_LIMIT = 400


class Absent(NamedTuple):
    """The steps of an episode, from `first` to `last`, in which a key has no message."""

    run: str
    episode: int
    key: str
    first: int
    last: int


@dataclass
class Missing:
    """What a log lacks.

    `lost`: messages that are missing by their sequence numbers, for each key. `heartbeats`: missing status messages;
    nobody keeps a copy of them, so they do not make a log incomplete. `absent`: stretches of steps without a topic that
    every step should have, the first MOST_ABSENT of them. `repeated`: messages that are there twice. `refused`: entries
    that are not valid messages. `unfinished`: how far the run came, if it was not finished. `episodes`: stretches of
    whole episodes that are missing. `beyond`: stretches of episodes that the run did not have. `cut`: why the file is
    not whole.
    """

    messages: int = 0
    repeated: int = 0
    heartbeats: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    absent: list[Absent] = field(default_factory=list)
    episodes: list[tuple[int, int]] = field(default_factory=list)
    beyond: list[tuple[int, int]] = field(default_factory=list)
    refused: int = 0
    unfinished: str | None = None
    cut: str | None = None

    @property
    def count(self) -> int:
        """The number of messages that are missing."""
        return sum(self.lost.values()) + sum(stretch.last - stretch.first + 1 for stretch in self.absent)

    @property
    def complete(self) -> bool:
        """Whether the log holds messages, and nothing is missing."""
        return self.messages > 0 and not (self.lost or self.absent or self.repeated or self.refused or self.episodes
                                          or self.beyond or self.unfinished or self.cut)

    def lines(self) -> Iterator[str]:
        """Yields one line for each thing that is missing."""
        yield from (printable(line, LINE_LIMIT) for line in self._lines())

    def _lines(self) -> Iterator[str]:
        if self.cut:
            yield self.cut
        if self.unfinished:
            yield self.unfinished
        if not self.messages:
            yield "holds no message"
        if self.episodes:
            yield f"episodes that are not there: {in_stretches(self.episodes)}"
        if self.beyond:
            yield f"messages of episodes that the run did not have: {in_stretches(self.beyond)}"
        for key, count in sorted(self.lost.items()):
            yield f"{key}: {count} messages lost, by their sequence numbers"
        for (run, episode, key), group in itertools.groupby(sorted(self.absent), lambda at: at[:3]):
            steps = in_stretches([(at.first, at.last) for at in group])
            yield f"{key}: not there in episode {episode} of {run}, step {steps}"
        if len(self.absent) >= MOST_ABSENT:
            yield "more steps lack something: they are not listed"
        if self.repeated:
            yield f"{self.repeated} messages are there twice"
        if self.refused:
            yield f"{self.refused} entries are no valid messages"


def missing(path: Path) -> Missing:
    """Reads a log and returns what it lacks.

    The last step of an episode needs no answer to its frame. If the log was cut out of another one, only the steps of
    its range are expected. In live mode (`bus.live`) no step needs an answer. Raises SaccadeError if the file is not a
    log, or if it is damaged from its start on.
    """
    report, reader, sequences, there = Missing(), RunReader(path), None, There()
    for topic, part, message in reader:
        sequences = sequences or Sequences(from_start=True, cut=range_of(reader) is not None)
        report.messages += 1
        lost = sequences.take(topic, part, message)
        report.repeated += lost is None
        report.heartbeats += 0 if topic.in_step else lost or 0
        there.take(topic, topic.key(reader.world, part), message)
    if not report.messages:
        reader.require_something()
    kept = range_of(reader)
    if not setting_of(reader, "bus", "live"):
        absent = itertools.chain(there.absent(kept), there.not_held(RESULT.key(reader.world)))
        report.absent = sorted(itertools.islice(absent, MOST_ABSENT))
    if sequences is not None:
        report.lost = {TOPICS[name].key(reader.world, part): lost for (name, part), lost in sequences.missing.items()}
    if kept is None and AWAITED in reader.metadata:
        report.unfinished, report.episodes, report.beyond = _unfinished(reader, there)
    report.refused, report.cut = reader.refused, reader.cut
    return report


class There:
    """What a log holds of each episode: the steps of each key, the latched messages, and the step at which it was
    done."""

    def __init__(self) -> None:
        self.steps: dict[tuple[str, int], dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        self.held: dict[tuple[str, int], set[str]] = defaultdict(set)
        self.done: dict[tuple[str, int], set[int]] = defaultdict(set)

    def take(self, topic: Topic, key: str, message: Message | Stamp) -> None:
        """Notes a message. Its stamp is enough, unless it is a Truth."""
        at = message.run, message.episode
        if topic.latched:
            self.held[at].add(key)
        elif topic.in_step:
            self.steps[at][key].add(message.step)
            if isinstance(message, Truth) and message.done:
                self.done[at].add(message.step)

    def absent(self, kept: Range | None) -> Iterator[Absent]:
        """Yields the steps that are missing for each episode and key, as stretches, because there may be too many to
        count."""
        keys = sorted(set().union(*(of_key for of_key in self.steps.values())))
        for episode, of_key in self.steps.items():
            first, last = 0, max(max(steps) for steps in of_key.values())
            if kept is not None:
                first, last = kept.start, max(kept.end or 0, last)
            for key in keys:
                for stretch in between(of_key.get(key, set()) | self.done.get(episode, set()), first, last):
                    yield Absent(*episode, key, *stretch)

    def not_held(self, result: str) -> Iterator[Absent]:
        """Yields the latched messages that one episode has and another lacks. Only an episode that is over has a
        result."""
        keys = set().union(*self.held.values())
        for episode in self.steps:
            for key in keys - self.held.get(episode, set()):
                if key != result or self.done.get(episode):
                    yield Absent(*episode, key, 0, 0)


def _unfinished(reader: RunReader, there: There) -> tuple[str | None, list[tuple[int, int]], list[tuple[int, int]]]:
    """Returns how far the run came if it was not finished. If it was finished, returns which whole episodes are
    missing, and which are there although the run did not have them."""
    found = {episode for _, episode in there.steps}
    if FINISHED not in reader.metadata:
        last = max(found, default=None)
        how_far = "before its first step" if last is None else f"in episode {last}"
        return (f"the run was not finished: it was ended {how_far}, and its source did not say that this was the last "
                "step; start a new run for the rest"), [], []
    told = reader.metadata[FINISHED].get("episodes", "")
    count = int(told) if told.isascii() and told.isdigit() and len(told) < 20 else 0
    all_found = found | {episode for _, episode in there.held}
    beyond = sorted(episode for episode in all_found if 0 < count <= episode)
    return (None, list(itertools.islice(between(found, 0, count - 1), MOST_ABSENT)),
            [(episode, episode) for episode in beyond[:MOST_ABSENT]])


def between(numbers: set[int], first: int, last: int) -> Iterator[tuple[int, int]]:
    """Yields the stretches from `first` to `last` that hold none of the numbers, each as its first and last number."""
    due = first
    for number in sorted(numbers):
        if number > last:
            break
        if number > due:
            yield due, number - 1
        due = max(due, number + 1)
    if due <= last:
        yield due, last


def abbreviated(numbers: Iterable[int]) -> str:
    """Returns ascending numbers as text, joined to stretches: 1-3, 7, 9-12."""
    return in_stretches([(number, number) for number in numbers])


def in_stretches(stretches: Iterable[tuple[int, int]]) -> str:
    """Returns ascending stretches as text. Stretches that follow each other directly are joined: 1-3, 7, 9-12."""
    joined: list[tuple[int, int]] = []
    for first, last in stretches:
        if joined and first == joined[-1][1] + 1:
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    told = [f"{first}" if first == last else f"{first}-{last}" for first, last in joined]
    more = len(told) - MOST_STRETCHES
    return ", ".join(told[:MOST_STRETCHES]) + (f" and {more} stretches more" if more > 0 else "")
