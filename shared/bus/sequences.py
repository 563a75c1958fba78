"""Sequence numbers: per key, from 0 in every episode, so that a service that was started again gives the same ones."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Output, Topic
from saccade.shared.bus.wire import Stamp

Key = tuple[str, str | None]  # topic and part
Episode = tuple[str, int]  # run and number


class Stamper:
    """Numbers the messages of an episode per key, in the order in which they are made. With `first_step`, by their
    step: of each key there is one a step, or one an episode where it is latched, whoever makes it."""

    def __init__(self, first_step: int | None = None) -> None:
        self._next: dict[tuple[str, str | None], int] = {}
        self._first_step = first_step

    def stamp(self, output: Output) -> Output:
        """The output with its sequence number."""
        key = (output.topic.name, output.part)
        seq = self._next.get(key, 0)
        if self._first_step is not None:
            seq = 0 if output.topic.latched else output.message.step - self._first_step
        self._next[key] = seq + 1
        return dataclasses.replace(output, message=dataclasses.replace(output.message, seq=seq))


class Missing:
    """Which numbers of one key in one episode have not come, as ranges: memory grows with what came, not with what a
    number claims."""

    def __init__(self) -> None:
        self._ranges: list[tuple[int, int]] = []  # [first, end) in rising order, apart from one another
        self.count = 0

    def add(self, first: int, end: int) -> None:
        """Numbers beyond all that are known."""
        self._ranges.append((first, end))
        self.count += end - first

    def give_up(self) -> None:
        """Numbers are counted anew: those that are missing still count, and will not come."""
        self._ranges = []

    def remove(self, number: int) -> bool:
        """Whether the number was missing; it is no longer."""
        at = bisect_right(self._ranges, number, key=lambda known: known[0]) - 1
        if at < 0 or number >= self._ranges[at][1]:
            return False
        first, end = self._ranges[at]
        self._ranges[at:at + 1] = [part for part in ((first, number), (number + 1, end)) if part[0] < part[1]]
        self.count -= 1
        return True


class Sequences:
    """Which messages of each key were there. What is missing may still come, out of its turn.

    A status is not part of an episode: it counts from 0 in every process, and nobody can ask for it again. Where nobody
    waits, a service that was started again goes on with the newest step and counts anew: a number that was there
    already, of a step that was not.
    """

    def __init__(self, *, from_start: bool = False, cut: bool = False) -> None:
        self._from_start = from_start  # whether this listens since before the first message
        self._cut = cut  # whether every episode may begin at any number
        self._next: dict[Key, dict[Episode, int]] = {}
        self._last_step: dict[tuple[Key, Episode], int] = {}
        self._missing: dict[Key, dict[Episode, Missing]] = {}

    def take(self, topic: Topic, part: str | None, message: Message | Stamp) -> int | None:
        """How many messages of this key are missing just before this one; None for one that was there already."""
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
        """How many messages of each key have not come."""
        counts = {key: sum(missing.count for missing in episodes.values()) for key, episodes in self._missing.items()}
        return {key: count for key, count in counts.items() if count}

    @property
    def first_missing(self) -> int:
        """The first episode of which something has not come; 0 where all has."""
        return min((episode for episodes in self._missing.values() for (_, episode), missing in episodes.items()
                    if missing.count), default=0)

    def has_begun(self, key: Key, run: str, episode: int) -> bool:
        """Whether any message of this key in that episode was there."""
        return (run, episode) in self._next.get(key, {})

    def begins(self, topic: Topic, part: str | None, message: Message | Stamp) -> bool:
        """Whether this is the first message of its key in a later episode than those before it."""
        key = topic.name, part
        return topic.in_step and key in self._next and not self.has_begun(key, message.run, message.episode)
