"""Reads a log in Python as episodes of steps: `for episode in log: for step in episode`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from saccade.app.log.source import log_of
from saccade.shared.bus.messages import Action, Belief, Events, Frame, Goal, Percept, Plan, Result, Truth
from saccade.shared.bus.topics import (
    ACTION,
    BELIEF,
    EVENTS,
    FRAME,
    GOAL,
    GOAL_PERCEPT,
    PERCEPT,
    PLAN,
    RESULT,
    STATUS,
    TRUTH,
    Topic,
)
from saccade.shared.bus.wire import MessageError, Stamp, decode, stamp_of
from saccade.shared.config import Config, recorded
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader

WINDOW = 64  # steps that are kept open, because a recorder that was restarted logs late what it missed

Entries = dict[tuple[Topic, str | None], bytes]


class _Messages:
    """The messages of one step or one episode, which are decoded when they are asked for. A message that is not valid
    counts as missing."""

    def __init__(self) -> None:
        self._entries: Entries = {}
        self._decoded: dict[tuple[Topic, str | None], Any] = {}

    def _put(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self._entries.setdefault((topic, part), payload)

    def _get(self, topic: Topic, part: str | None = None) -> Any:
        key = topic, part
        if key not in self._decoded:
            self._decoded[key] = None
            if key in self._entries:
                with suppress(MessageError):
                    self._decoded[key] = decode(topic.type, self._entries[key])
        return self._decoded[key]

    def _by_part(self, topic: Topic) -> dict[str, Any]:
        found = {part: self._get(topic, part) for at, part in self._entries if at == topic and part is not None}
        return {part: message for part, message in sorted(found.items()) if message is not None}


class Step(_Messages):
    """All messages of one step. A message that the log lacks is None, or missing from the mapping."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    @property
    def frame(self) -> Frame | None:
        """What the camera saw."""
        return self._get(FRAME)

    @cached_property
    def percepts(self) -> Mapping[str, Percept]:
        """The percept of each object in the frame, by the object's name."""
        return self._by_part(PERCEPT)

    @cached_property
    def beliefs(self) -> Mapping[str, Belief]:
        """The belief about each object after the frame, by the object's name."""
        return self._by_part(BELIEF)

    @property
    def events(self) -> Events | None:
        """What the belief noticed in the frame: what was moved, taken away or put back, and what drifts."""
        return self._get(EVENTS)

    @property
    def plan(self) -> Plan | None:
        """The chosen viewpoint and the terms of its expected free energy."""
        return self._get(PLAN)

    @property
    def action(self) -> Action | None:
        """The move that followed."""
        return self._get(ACTION)

    @property
    def truth(self) -> Truth | None:
        """The simulator's ground truth. A real camera has none."""
        return self._get(TRUTH)

    def __repr__(self) -> str:
        return f"<Step {self.number}: {', '.join(sorted({topic.name for topic, _ in self._entries}))}>"


class Episode(_Messages):
    """One episode. Iterating yields its steps in order, once."""

    def __init__(self, number: int, steps: Iterator[Step]) -> None:
        super().__init__()
        self.number, self._steps = number, steps
        self._gone = ""  # why there are no steps to read any more

    def __iter__(self) -> Iterator[Step]:
        """Yields the steps. Raises SaccadeError if they have been read already, or were passed over because the result
        or the next episode was asked for before."""
        while not self._gone:
            step = next(self._steps, None)
            if step is None:
                self._gone = f"the steps of episode {self.number} have been read already"
                return
            yield step
        raise SaccadeError(f"{self._gone}, and a log is read once: keep the steps in a list before you ask for the "
                           "result or for the next episode, or open the log again")

    def _pass_over(self) -> None:
        left = sum(1 for _ in self._steps)
        if left:
            self._gone = f"{left} steps of episode {self.number} were passed over"

    @property
    def goal(self) -> Goal | None:
        """The image that the agent had to reach. It is known from the first step on."""
        return self._get(GOAL)

    @cached_property
    def goal_percepts(self) -> Mapping[str, Percept]:
        """The percept of each object in the goal image, by the object's name. They are known from the first step on."""
        return self._by_part(GOAL_PERCEPT)

    @property
    def result(self) -> Result | None:
        """How the episode ended. This passes over the steps that were not read yet, so ask for it after the steps."""
        self._pass_over()
        return self._get(RESULT)

    def __repr__(self) -> str:
        return f"<Episode {self.number}>"


class Log:
    """The log of a run. Iterating reads the file from its start, and yields its episodes in order. Iterating again
    reads the file again. An episode must be read before its result or the next episode is asked for."""

    def __init__(self, path: str | Path) -> None:
        """`path` is the folder of a run, or its log. Raises SaccadeError if it is not a log."""
        self.path = log_of(Path(path))
        self._reader = RunReader(self.path)

    @cached_property
    def config(self) -> Config:
        """The resolved configuration of the run. Raises SaccadeError if the log holds none."""
        if self._reader.configuration is None:
            next(self._reader.entries(), None)  # it comes before the first message
        if self._reader.configuration is None:
            raise SaccadeError(f"log {self.path} holds no configuration")
        return recorded(self._reader.configuration, f"the log {self.path}")

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects that the agent knew."""
        return self.config.names

    def __iter__(self) -> Iterator[Episode]:
        entries = _Entries(self.path)
        while (number := entries.episode) is not None:
            episode = Episode(number, iter(()))
            steps = _steps(entries, episode)
            first = next(steps, None)  # when it is read, the goal is known
            episode._steps = steps if first is None else chain((first,), steps)
            yield episode
            episode._pass_over()

    def __repr__(self) -> str:
        return f"<Log {self.path}>"


class _Entries:
    """The entries of a log, of which the next one can be looked at."""

    def __init__(self, path: Path) -> None:
        self._entries = RunReader(path).entries()
        self.next: tuple[Topic, str | None, bytes, Stamp] | None = None
        self.advance()

    @property
    def episode(self) -> int | None:
        """The episode of the next entry. None at the end."""
        return self.next[3].episode if self.next else None

    def advance(self) -> None:
        """Goes on to the next entry. An entry without a stamp is left out because it is not a message, and a status
        because it belongs to no step. A message of an episode is too late when the next episode has begun."""
        last, self.next = self.next, None
        for entry in self._entries:
            if entry.topic == STATUS:
                continue
            try:
                stamp = stamp_of(entry.payload)
            except MessageError:
                continue
            if last is None or stamp.episode >= last[3].episode:
                self.next = entry.topic, entry.part, entry.payload, stamp
                return


def _steps(entries: _Entries, episode: Episode) -> Iterator[Step]:
    """Yields the steps of an episode in order. The latched messages go to the episode itself."""
    waiting: dict[int, Step] = {}
    given = -1
    while entries.next is not None and entries.episode == episode.number:
        topic, part, payload, stamp = entries.next
        if topic.latched:
            episode._put(topic, part, payload)
        elif stamp.step > given:
            waiting.setdefault(stamp.step, Step(stamp.step))._put(topic, part, payload)
        entries.advance()
        while waiting and min(waiting) <= stamp.step - WINDOW:
            given = min(waiting)
            yield waiting.pop(given)
    for number in sorted(waiting):
        yield waiting[number]

