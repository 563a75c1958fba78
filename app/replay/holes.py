"""Steps of a damaged log that a replay cannot be compared in, because the log lacks a part of them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from saccade.app.log.check import MOST_ABSENT, There
from saccade.app.log.cut import range_of
from saccade.shared.bus.topics import TRUTH, Topic, parse_key
from saccade.shared.bus.wire import MessageError, decode, stamp_of
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RECOVERED

Key = tuple[str, str | None]  # topic and part


@dataclass
class Holes:
    """What a log that was cut, or recovered with a loss, lacks of each episode. Empty for any other log.

    From the step in `limits` on, an episode cannot be replayed: an input is lost, and a service needs all of them.
    """

    damaged: bool = False
    limits: dict[int, int] = field(default_factory=dict)
    _keys: set[Key] = field(default_factory=set)
    _partial: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  # stretches of steps that lack something
    _end: tuple[int, int] = (0, 0)  # newest episode and its newest step, of which the cut may have taken a part

    def cannot_be_replayed(self, episode: int, step: int) -> bool:
        """Whether an input of this step, or of one before it in its episode, is lost."""
        return episode in self.limits and step >= self.limits[episode]

    def may_lack(self, topic: Topic, part: str | None, episode: int, step: int) -> bool:
        """Whether a message that is not in the recording may have been lost with a part of the log."""
        if not self.damaged:
            return False
        if topic.latched:
            return episode == self._end[0] or bool(self._partial.get(episode))
        return ((topic.name, part) in self._keys or (episode, step) == self._end
                or any(first <= step <= last for first, last in self._partial.get(episode, ())))


def holes_of(log: Path, inputs: Sequence[Topic], outputs: Sequence[Topic], parts: Sequence[str], *,
             live: bool) -> Holes:
    """Reads a log and returns what it lacks, if it is damaged.

    `inputs` are the topics that are played, `outputs` those that are compared, `parts` the objects of the run. Of a log
    that was recorded live, only the steps that have outputs need inputs. Raises SaccadeError for a file that is no log.
    """
    reader, there = RunReader(log), There()
    for topic, part, payload, _ in reader.entries():
        with suppress(MessageError):
            there.take(topic, topic.key(reader.world, part),
                       decode(TRUTH.type, payload) if topic == TRUTH else stamp_of(payload))
    if not there.steps or (reader.cut is None and not reader.metadata.get(RECOVERED, {}).get("lost")):
        return Holes()
    holes, names = Holes(damaged=True), {topic.name for topic in inputs}
    for at in itertools.islice(there.absent(range_of(reader)), MOST_ABSENT):
        topic, part = parse_key(at.key)[1:]
        holes._keys.add((topic.name, part))
        holes._partial.setdefault(at.episode, []).append((at.first, at.last))
        if topic.name in names and not live:
            holes.limits[at.episode] = min(at.first, holes.limits.get(at.episode, at.first))
    newest = max(there.steps, key=lambda at: at[1])
    holes._end = newest[1], max(max(steps) for steps in there.steps[newest].values())
    for (_, episode), of_key in there.steps.items():
        held = {parse_key(key)[1:] for key in there.held[_, episode]}
        for topic in (topic for topic in inputs if topic.latched):
            if any((topic, part) not in held for part in (parts if topic.parts else (None,))):
                holes.limits[episode] = 0
        if live:
            _limit_live(holes, episode, of_key, names, {topic.name for topic in outputs})
    return holes


def _limit_live(holes: Holes, episode: int, of_key: dict[str, set[int]], inputs: set[str], outputs: set[str]) -> None:
    """The first step that was answered then, and of which an input is lost."""
    steps_of = {key: steps for key, steps in of_key.items() if parse_key(key)[1].name in inputs}
    answered = set().union(*(steps for key, steps in of_key.items() if parse_key(key)[1].name in outputs))
    lost = [step for step in answered if any(step not in steps for steps in steps_of.values())]
    if lost:
        holes.limits[episode] = min(min(lost), holes.limits.get(episode, min(lost)))
