"""Whether everything of an episode has been recorded: the source begins the next one only then."""

from __future__ import annotations

from saccade.shared.bus.messages import Message, Status, Truth
from saccade.shared.bus.topics import RESULT, TOPICS, Topic


class Whole:
    """Follows the episodes of a run, one after another, by the messages that were recorded.

    `episode` is the one that is followed. It is over when its result is there. It is whole when every key that the run
    has used came as far as the episode did. In the first episode it is not known which keys there are, so `services`
    must have been heard to have come as far. Without `services` no episode is over, because nobody waits for it.
    """

    def __init__(self, run: str, services: set[str] | None) -> None:
        self._run, self._services = run, services
        self.episode = 0
        self._last: dict[tuple[str, str | None], tuple[int, int]] = {}  # newest (episode, step) of each key
        self._heard: dict[str | None, tuple[int, int]] = {}  # of each service
        self._steps: dict[int, int] = {}  # the last step of each episode that is done
        self._results: set[int] = set()

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
        self._last[key] = max(self._last.get(key, (0, -1)), (message.episode, 0 if topic.latched else message.step))

    @property
    def is_over(self) -> bool:
        """Whether the episode has its result."""
        return self._services is not None and self.episode in self._results

    @property
    def is_whole(self) -> bool:
        """Whether every key came as far as the episode did. Its last image needs no answer."""
        if self.episode not in self._steps:
            return False
        # A latched message counts as one of step 0.
        last = self._steps[self.episode] - 1
        far = all(at >= (self.episode, 0 if TOPICS[name].latched else last) for (name, _), at in self._last.items())
        if self.episode > 0 or self._services is None:
            return far
        return far and all(self._heard.get(name, (0, -1)) >= (0, last) for name in self._services)

    def next(self) -> int:
        """Goes on to the next episode, and returns its number."""
        self._results.discard(self.episode)
        self._steps.pop(self.episode, None)
        self.episode += 1
        return self.episode
