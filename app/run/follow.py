"""Hears what is said on the bus of a run, and follows the run until it is over."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from saccade.app.run.halt import Pulse
from saccade.app.run.supervisor import Process
from saccade.shared.bus.messages import Message, Result, Status
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import PLAN, RESULT, STATUS, Topic
from saccade.shared.bus.transport import Bus
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import NAME_LIMIT, SaccadeError, printable, told
from saccade.shared.log.folder import LOGS_NAME
from saccade.shared.loop.episodes import READY_STATES, stranger
from saccade.shared.loop.process import Item

Told = tuple[Topic, str | None, Message]
OnMessage = Callable[[Topic, str | None, Message], None]
FOLLOWED = (STATUS, PLAN, RESULT)  # these topics tell the launcher how far a run is
READY_S = 120.0  # on a busy machine it takes long to load weights
POLL_S = 0.2
MOST_NAMED = 20  # things that are ignored and named
# After so long without news the launcher asks for results: one may have been published while the router was away.
QUIET_S = 2.0
WORKED_OFF_S = 10.0  # If nobody judges: after so long without news the plan for the last frame will not come any more.
JUDGE = "evaluator"


class Watch(Protocol):
    """What knows the state of the services of a run: their supervisor, or an object that only hears their
    heartbeats."""

    stopped: bool

    def heard(self, name: str, state: str) -> None:
        """Takes a heartbeat."""

    def check(self) -> None:
        """It must be called a few times a second."""

    def settled(self, since_s: float) -> bool:
        """Whether all services were heard since that time (monotonic clock, seconds)."""


class Messages:
    """Yields (topic, part, message) as they arrive, each once, and None when nothing arrived. It does not end.

    While it is iterated, `watch` is called. Messages of other runs are ignored, and so are those for which
    `refusal(topic, part, message)` gives a reason; `say` is told of each kind once.
    """

    def __init__(self, arrived: queue.SimpleQueue[Item], bus: Bus, watch: Watch, run: str,
                 say: Callable[[str], None]) -> None:
        self._arrived, self._bus, self._watch, self._run, self._say = arrived, bus, watch, run, say
        self.refusal: Callable[[Topic, str | None, Message], str | None] = lambda _topic, _part, _message: None
        self._sequences, self._named = Sequences(), set[str]()
        self._looked_s = self._news_s = time.monotonic()
        self._due = 0
        self._asking: threading.Thread | None = None

    @property
    def caught_up(self) -> bool:
        """Whether everything has been given that had arrived a moment ago. Only then does silence mean something."""
        return self._due <= 0

    def __iter__(self) -> Iterator[Told | None]:
        return self

    def __next__(self) -> Told | None:
        while True:
            if self.caught_up:
                self._look()
                self._due = self._arrived.qsize()
            try:
                topic, part, payload = self._arrived.get(timeout=POLL_S)
            except queue.Empty:
                self._due = 0
                return None
            self._due -= 1
            message = self._taken(topic, part, payload)
            if message is not None:
                return topic, part, message
            if self.caught_up:
                return None

    def rest(self) -> Iterator[Told]:
        """Yields what is still on its way when everybody has been stopped."""
        while (item := next(self)) is not None or not self._arrived.empty():
            if item is not None:
                yield item

    def _look(self) -> None:
        now_s = time.monotonic()
        if now_s - self._looked_s >= POLL_S:
            self._looked_s = now_s
            self._watch.check()
        if now_s - self._news_s >= QUIET_S and not self._watch.stopped:
            self._news_s = now_s
            self._ask()

    def _ask(self) -> None:
        """Asks for results on a thread of its own, because somebody on the bus may never answer."""
        if self._asking is None or not self._asking.is_alive():
            self._asking = threading.Thread(target=self._recall, name="recall", daemon=True)
            self._asking.start()

    def _recall(self) -> None:
        for topic, part, payload, *_ in self._bus.recall((RESULT,), (self._run, 0, 0)):
            self._arrived.put((topic, part, payload))

    def _taken(self, topic: Topic, part: str | None, payload: bytes) -> Message | None:
        try:
            message = decode(topic.type, payload)
        except MessageError:  # a service that gets an invalid message counts it
            return None
        if isinstance(message, Status):
            if (reason := stranger(message, part, self._run)) is not None:
                self._name(f"status/{printable(part or '', NAME_LIMIT)} came on the bus and is ignored: {reason}")
                return None
            if part is not None:
                self._watch.heard(part, message.state)
        elif message.run != self._run:
            self._name(f"a {topic.name} of another run, {told(message.run)}, came on the bus: such messages are "
                       "ignored")
            return None
        elif (reason := self.refusal(topic, part, message)) is not None:
            self._name(reason)
            return None
        if self._sequences.take(topic, part, message) is None:
            return None
        if topic != STATUS:
            self._news_s = time.monotonic()
        return message

    def _name(self, what: str) -> None:
        if what not in self._named and len(self._named) < MOST_NAMED:
            self._named.add(what)
            self._say(what)


def follow(told: Messages, watch: Watch, processes: Sequence[Process],
           on_message: OnMessage | None, *, live: bool) -> list[Result]:
    """Follows a run until it is over, and returns its results in the order of the episodes. Raises SaccadeError if a
    service is not ready within READY_S, or if all services wait for one another; `live`, they may wait for a camera."""
    starting = {process.name for process in processes[1:] if not process.onlooker}
    pulse = Pulse(set() if live else set(starting))
    course = Course(processes[1].name, judged=JUDGE in starting)
    told.refusal = course.refusal
    over_s, deadline_s = None, time.monotonic() + READY_S
    for item in told:
        if starting and time.monotonic() > deadline_s:
            raise SaccadeError(f"{', '.join(sorted(starting))}: not ready after {READY_S:.0f} s; see {LOGS_NAME}/")
        over_s = (over_s or time.monotonic()) if course.over else None
        if over_s is not None and watch.settled(over_s):
            break
        if item is not None:
            topic, part, message = item
            if on_message is not None:
                on_message(topic, part, message)
            course.take(topic, part, message)
            pulse.take(topic, part, message)
            if isinstance(message, Status) and part is not None and message.state in READY_STATES:
                starting.discard(part)
        if over_s is None and told.caught_up and (why := pulse.halted()):
            raise SaccadeError(why)
    return course.in_order


class Course:
    """Keeps track of how far a run has come."""

    def __init__(self, source: str, *, judged: bool) -> None:
        self._results: dict[int, Result] = {}
        self._source, self._judged = source, judged
        self._reached = 0  # the episode that the source is in
        self._end: tuple[int, int] | None = None  # the last episode and step of the source
        self._planned, self._news_s = (-1, -1), time.monotonic()

    def refusal(self, topic: Topic, part: str | None, message: Message) -> str | None:
        """Says why a message cannot be one of this run: there is no result of an episode that has not begun, and
        nothing of an episode after the next one. A result that overtook everything else of its episode comes again
        when it is asked for."""
        if topic.in_step and message.episode > self._reached + (topic != RESULT):
            return (f"a {topic.name} of episode {message.episode} came while episode {self._reached} went on: it is "
                    "ignored")
        return None

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes any message."""
        if topic.in_step:
            self._news_s = time.monotonic()
        if isinstance(message, Result):
            self._results[message.episode] = message
        elif isinstance(message, Status):
            if part == self._source and message.run:
                self._reached = max(self._reached, message.episode)
                if message.state == "finished":
                    self._end = (message.episode, message.step)
        elif message.episode == self._reached + 1:
            self._reached += 1
        if topic == PLAN:
            self._planned = max(self._planned, (message.episode, message.step))

    @property
    def over(self) -> bool:
        """Whether the source has finished and every episode has its result. If nobody judges, the last frame must have
        its plan instead."""
        if self._end is None:
            return False
        if self._judged:
            return len(self.in_order) > self._end[0]
        return self._planned >= self._end or time.monotonic() - self._news_s > WORKED_OFF_S

    @property
    def in_order(self) -> list[Result]:
        """The results in the order of the episodes, up to the last one of the source."""
        last = self._end[0] if self._end else None
        return [self._results[episode] for episode in sorted(self._results) if last is None or episode <= last]
