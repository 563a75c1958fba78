"""Sequence numbers. Each key counts from 0 in every episode, so a service that was started again gives the same
numbers."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Output, Topic
from saccade.shared.bus.wire import Stamp

Key = tuple[str, str | None]  # topic and part
Episode = tuple[str, int]  # run and number


class Stamper:
    """Numbers the messages of an episode for each key, in the order in which they are made.

    With `first_step` the number follows from the step of the message instead. It is then the same whichever copy of a
    service makes the message: a key has one message per step, or one per episode if its topic is latched.
    """

    def __init__(self, first_step: int | None = None) -> None:
        self._next: dict[tuple[str, str | None], int] = {}
        self._first_step = first_step

    def stamp(self, output: Output) -> Output:
        """Returns the output with its sequence number."""
        key = (output.topic.name, output.part)
        seq = self._next.get(key, 0)
        if self._first_step is not None:
            seq = 0 if output.topic.latched else output.message.step - self._first_step
        self._next[key] = seq + 1
        return dataclasses.replace(output, message=dataclasses.replace(output.message, seq=seq))


class Missing:
    """The sequence numbers of one key in one episode that have not arrived.

    They are kept as ranges. So memory grows with the number of messages that arrived, not with the numbers that they
    claim.
    """

    def __init__(self) -> None:
        self._ranges: list[tuple[int, int]] = []  # [first, end) in rising order, apart from one another
        self.count = 0

    def add(self, first: int, end: int) -> None:
        """Adds the numbers from `first` up to `end`, without `end`. They must be higher than all numbers that are
        known."""
        self._ranges.append((first, end))
        self.count += end - first

    def give_up(self) -> None:
        """Forgets which numbers are missing, because the publisher counts anew. They still count, and they will not
        arrive."""
        self._ranges = []

    def remove(self, number: int) -> bool:
        """Removes a number from the missing ones. Returns whether it was missing."""
        at = bisect_right(self._ranges, number, key=lambda known: known[0]) - 1
        if at < 0 or number >= self._ranges[at][1]:
            return False
        first, end = self._ranges[at]
        self._ranges[at:at + 1] = [part for part in ((first, number), (number + 1, end)) if part[0] < part[1]]
        self.count -= 1
        return True


class Sequences:
    """Remembers which messages of each key have arrived. A message that is missing may still arrive later, out of
    order.

    A status does not belong to an episode: it counts from 0 in every process, and nobody can ask for it again. In live
    mode, a service that was started again continues with the newest step and counts anew. This is noticed when a
    sequence number that was already used comes with a later step.
    """

    def __init__(self, *, from_start: bool = False, cut: bool = False) -> None:
        self._from_start = from_start  # whether it has listened since before the first message
        self._cut = cut  # whether every episode may begin at any number
        self._next: dict[Key, dict[Episode, int]] = {}
        self._last_step: dict[tuple[Key, Episode], int] = {}
        self._missing: dict[Key, dict[Episode, Missing]] = {}

    def take(self, topic: Topic, part: str | None, message: Message | Stamp) -> int | None:
        """Takes a message. Returns how many messages of its key are missing directly before it, or None if it has
        arrived before."""
        key, episode, seq = (topic.name, part), (message.run, message.episode), message.seq
        if not topic.in_step:
            known = self._next.get(key, {}).get(("", 0), seq)
            self._next[key] = {("", 0): seq + 1}
            return max(0, seq - known)
        episodes = self._next.setdefault(key, {})
        first = 0 if (episodes or self._from_start) and not self._cut else seq
        due = episodes.get(episode, first)
        last_step = self._last_step.get((key, episode), message.step)
        self._last_step[key, episode] = max(last_step, message.step)
        if seq < due and message.step > last_step:
            due = 0
            self._missing.get(key, {}).get(episode, Missing()).give_up()
        if seq >= due:
            episodes[episode] = seq + 1
            if seq > due:
                self._missing.setdefault(key, {}).setdefault(episode, Missing()).add(due, seq)
            return seq - due
        missing = self._missing.get(key, {}).get(episode)
        return 0 if missing is not None and missing.remove(seq) else None

    @property
    def missing(self) -> dict[Key, int]:
        """How many messages of each key have not arrived. Keys that lack nothing are left out."""
        counts = {key: sum(missing.count for missing in episodes.values()) for key, episodes in self._missing.items()}
        return {key: count for key, count in counts.items() if count}

    def lacks(self, run: str, episode: int) -> bool:
        """Whether a message of that episode has not arrived although a later one of its key has."""
        return any(episodes[run, episode].count for episodes in self._missing.values() if (run, episode) in episodes)

    @property
    def first_missing(self) -> int:
        """The first episode in which a message is missing. It is 0 if nothing is missing."""
        return min((episode for episodes in self._missing.values() for (_, episode), missing in episodes.items()
                    if missing.count), default=0)

    def has_begun(self, key: Key, run: str, episode: int) -> bool:
        """Whether any message of this key in that episode has arrived."""
        return (run, episode) in self._next.get(key, {})

    def begins(self, topic: Topic, part: str | None, message: Message | Stamp) -> bool:
        """Whether this message is the first of its key in its episode, while other episodes of the key have begun
        before."""
        key = topic.name, part
        return topic.in_step and key in self._next and not self.has_begun(key, message.run, message.episode)
