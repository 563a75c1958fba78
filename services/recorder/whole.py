"""Whether everything of an episode has been recorded: the source begins the next one only then."""

from __future__ import annotations

import math
from collections.abc import Iterable

from saccade.shared.bus.messages import Message, Status, Truth
from saccade.shared.bus.sequences import Key
from saccade.shared.bus.topics import RESULT, TOPICS, Topic

SILENT_S = 2.0  # a service that was not heard for this time hangs or is starting again


class Whole:
    """Follows the episodes of a run, one after another, by the messages that were recorded.

    `episode` is the one that is followed. It is over when its result is there. It is whole when every key that the run
    has used came as far as the episode did. In the first episode it is not known which keys there are, so `services`
    must have been heard to have come as far. Without `services` no episode is over, because nobody waits for it.
    """

    def __init__(self, run: str, services: set[str] | None) -> None:
        self._run, self._services = run, services
        self.episode = 0
        self.last: dict[Key, tuple[int, int]] = {}  # newest (episode, step) of each key
        self._heard: dict[str | None, tuple[int, int]] = {}  # of each service
        self._steps: dict[int, int] = {}  # the last step of each episode that is done
        self._results: set[int] = set()
        self._seldom: set[Key] = set()  # keys that were waited for in vain

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes a message of this run."""
        at = message.episode, message.step
        if isinstance(message, Status):
            if message.run == self._run:
                self._heard[part] = max(self._heard.get(part, (0, -1)), at)
            return
        if topic == RESULT:
            self._results.add(message.episode)
        if isinstance(message, Truth) and message.done:
            self._steps[message.episode] = message.step
        key = topic.name, part
        self.last[key] = max(self.last.get(key, (0, -1)), at)

    @property
    def is_over(self) -> bool:
        """Whether the episode has its result."""
        return self._services is not None and self.episode in self._results

    @property
    def is_whole(self) -> bool:
        """Whether every key came as far as the episode did. Its last image needs no answer."""
        if self.episode not in self._steps:
            return False
        if self._lacking():
            return False
        last = self._steps[self.episode] - 1
        return self.episode > 0 or all(self._heard.get(name, (0, -1)) >= (0, last) for name in self._services or ())

    def _lacking(self) -> set[Key]:
        """The keys that did not come as far as the episode did. A latched message may have any step."""
        last = self._steps.get(self.episode, 0) - 1
        return {key for key, at in self.last.items() if key not in self._seldom
                and at < (self.episode, 0 if TOPICS[key[0]].latched else last)}

    def give_up(self) -> None:
        """Does not wait for the keys any more that lack the end of the episode: a service may say something at some of
        the steps only."""
        self._seldom |= self._lacking()

    def next(self) -> int:
        """Goes on to the next episode, and returns its number."""
        self._results.discard(self.episode)
        self._steps.pop(self.episode, None)
        self.episode += 1
        return self.episode


class Patience:
    """How long messages are waited for that do not come: until all services have been heard for a while, and none has
    published anything. One that is starting again is not heard, and then repeats what it has published."""

    def __init__(self, services: Iterable[str], patience_s: float) -> None:
        self._heard_s = dict.fromkeys(services, -math.inf)
        self._patience_s, self._since_s = patience_s, -math.inf

    def heard(self, service: str | None, now_s: float) -> None:
        """Takes note of a status."""
        if service in self._heard_s:
            self._heard_s[service] = now_s

    def is_over(self, now_s: float, news_s: float) -> bool:
        """Whether there is nothing to be waited for any more. The last message of a step came at `news_s`."""
        if any(now_s - heard_s > SILENT_S for heard_s in self._heard_s.values()):
            self._since_s = now_s
        self._since_s = max(self._since_s, news_s)
        return now_s - self._since_s >= self._patience_s
