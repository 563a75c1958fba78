"""The one main loop of every service, and the runner that drives the same cores in one process."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from shared.bus import Bus, ZenohBus
from shared.config import Config
from shared.errors import SaccadeError
from shared.messages import Message
from shared.outbox import Outbox
from shared.process import DRAIN_S, Health, Heartbeat, Inbox, run_process
from shared.sequences import Sequences
from shared.service import Core, Output, Service
from shared.stepper import Stepper, settle
from shared.ticker import Ticker
from shared.topics import STATUS, Topic
from shared.wire import MessageError, decode, encode

OnMessage = Callable[[Topic, str | None, Message, bytes | None], None]
OnStep = Callable[[str, float], None]
READY_STATES = ("ready", "busy")
IDLE_S = 1.0  # after so long without a message a service asks for what it lacks, and says so
WAITS = "waits for "


def main(service: Service, build: Callable[[Config], Core], *, source: bool = False,
         parts: tuple[str, ...] | None = None, argv: Sequence[str] | None = None) -> None:
    """A service's whole process: `--config RUN/config.json`, then messages in, messages out, until SIGTERM.

    `parts` are the objects' names, those of the configuration unless given. A `source` begins its episodes itself,
    the first once every service in `bus.wait_for` is ready; one that goes by time publishes a frame a period. Bad
    input ends the process with one line and code 2.
    """

    def work(config: Config, folder: Path, inbox: Inbox) -> None:
        names = parts if parts is not None else config.names
        core = build(config)
        bus = ZenohBus(config.bus.endpoint, world=config.bus.world)
        try:
            serve(service, core, bus, names, run=config.run or folder.name, source=source,
                  wait_for=config.bus.wait_for, inbox=inbox, live=config.bus.live, first_step=config.bus.first_step)
        finally:
            bus.close()

    run_process(service.name, work, argv=argv)


def serve(service: Service, core: Core, bus: Bus, parts: tuple[str, ...], *, run: str, source: bool = False,
          wait_for: tuple[str, ...] = (), inbox: Inbox | None = None, live: bool = False,
          first_step: int = 0) -> Health:
    """Runs a core on a bus until `inbox` is stopped; returns what it counted.

    What was published before this service was there, or while it or the router was away, is asked for: at the start,
    and whenever nothing comes. So a service that is started again folds the episode so far and goes on. `live`, it
    goes on with the newest.
    """
    inbox = inbox or Inbox()
    stepper = Stepper(service, core, parts, source=source, live=live, first_step=first_step)
    loop = _Loop(stepper, bus, run, wait_for if source else (), live=live)
    bus.answer(service.outputs, loop.outbox.answer)
    bus.subscribe(loop.topics + ((STATUS,) if loop.awaited else ()), inbox.put)
    with Heartbeat(bus, loop.health, inbox.stop):
        loop.health.say("ready", WAITS + ", ".join(sorted(loop.awaited)) if loop.awaited else loop.notes)
        loop.begin_if_due()
        loop.catch_up()
        news_s = time.monotonic()
        for item in inbox.items(0.0 if source else DRAIN_S, IDLE_S, lambda: loop.wait_s):
            if item is not None:
                loop.handle(*item, more=live and inbox.waiting)
            if not inbox.stopping.is_set():
                loop.tick_if_due()
            if item is not None and item[0] != STATUS:
                news_s = time.monotonic()
            elif time.monotonic() - news_s >= IDLE_S:
                news_s = time.monotonic()
                loop.catch_up()
                loop.say_what_lacks()
    return loop.health


class _Loop:
    """What one service does with one message."""

    def __init__(self, stepper: Stepper, bus: Bus, run: str, wait_for: tuple[str, ...], *, live: bool) -> None:
        service, core = stepper.service, stepper.core
        self.health, self.outbox, self.awaited = Health(service.name), Outbox(), set(wait_for)
        self.topics = service.inputs + ((service.closed_by,) if service.closed_by else ())
        self._source = stepper.episode_done  # between episodes from the start
        self._stepper, self._bus, self._run, self._service = stepper, bus, run, service
        self.notes = "\n".join(getattr(core, "notes", ()))
        self._ticker = Ticker(core.period_s) if stepper.timed else None
        self._live, self._sequences = live, Sequences()
        self._next_episode, self._closed = 0, -1
        self._end = core.episodes if self._source else 0

    def handle(self, topic: Topic, part: str | None, payload: bytes, *, more: bool = False) -> None:
        """Takes a message; runs the core for every complete step, unless there are `more` to look at first."""
        if topic == STATUS:
            self._note_status(part, payload)
            return
        self._take(topic, part, payload)
        while not more and self._step(topic, part, self._stepper.advance):
            self.begin_if_due()

    def _take(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self.health.received += 1
        try:
            message = decode(topic.type, payload)
            self.health.gaps += self._sequences.take(topic, part, message) or 0
            if topic == self._service.closed_by:
                self._close(message)
                return
            self._stepper.offer(topic, part, message)
        except MessageError as error:
            self.health.refuse(topic, part, error)

    def begin_if_due(self) -> None:
        """Begins a source's next episode, if everyone is there and the one before it is over and closed."""
        while self._source and not self.awaited and self._stepper.episode_done and self._is_closed:
            if self._next_episode >= self._end:
                self.health.say("finished")
                return
            episode, self._next_episode = self._next_episode, self._next_episode + 1
            self._step(None, None, lambda e=episode: self._stepper.begin(self._run, e))
            if self._ticker:
                self._ticker.start()

    def tick_if_due(self) -> None:
        """The next frame of a source that goes by time."""
        if self._ticker and self._ticker.take():
            self._step(None, None, self._stepper.tick)
            if self._stepper.episode_done:
                self._ticker.stop()
                self.begin_if_due()

    @property
    def wait_s(self) -> float:
        """Seconds until this service has something to do by itself."""
        return self._ticker.wait_s if self._ticker else math.inf

    def catch_up(self) -> None:
        """Asks for inputs that were published and have not come, until there are none that lead on. Where nobody waits
        what is past is past: only what holds for the whole episode is asked for."""
        latched = [topic for topic in self.topics if topic.latched and topic != self._service.closed_by]
        others = [topic for topic in self.topics if topic not in latched and not self._live]
        while not self.awaited:
            wants = self._stepper.wants
            kept = self._bus.recall(latched, wants and (*wants[:2], 0)) + self._bus.recall(others, wants)
            for topic, part, payload, *_ in kept:
                self.handle(topic, part, payload)
            if self._stepper.wants == wants:
                return

    def say_what_lacks(self) -> None:
        """Nothing has come for a while: puts the inputs that the next step still needs into the status."""
        if lacks := self._stepper.waits_for():
            self.health.say(note=WAITS + ", ".join(lacks))

    @property
    def _is_closed(self) -> bool:
        return self._service.closed_by is None or self._closed >= self._next_episode - 1

    def _close(self, message: Message) -> None:
        if message.run == self._run:
            self._closed = max(self._closed, message.episode)
            self.begin_if_due()

    def _note_status(self, part: str | None, payload: bytes) -> None:
        try:
            status = decode(STATUS.type, payload)
        except MessageError:
            return  # whoever sent it is not ready
        if part in self.awaited and status.state in READY_STATES:
            self.awaited.discard(part)
            if status.run == self._run:  # this source was here before: the others are in that episode already
                past = 1 if self._ticker else 0  # what one that goes by time has shown does not come back
                self._next_episode = max(self._next_episode, status.episode + past)
                self._closed = self._next_episode - 1
                self._end = self._stepper.core.episodes + past * self._next_episode
            if not self.awaited:
                self.health.say(note=self.notes)
                self.begin_if_due()
                self.catch_up()

    def _step(self, topic: Topic | None, part: str | None, make: Callable[[], list[Output] | None]) -> bool:
        """Runs the core once and publishes what it made; whether there was anything to do."""
        before, self.health.state = self.health.state, "busy"
        start = time.perf_counter()
        try:
            outputs = make()
            if outputs is None:
                return False
            self.health.milliseconds = (time.perf_counter() - start) * 1e3
            self._publish(outputs)
            if self.health.note.startswith(WAITS):
                self.health.say(note=self.notes)
        except MessageError as error:
            if topic is None:
                name = self.health.service
                raise SaccadeError(f"{name} cannot begin episode {self._next_episode - 1}: {error}") from error
            self.health.refuse(topic, part, error)
        finally:
            self.health.state = before
            self.health.at = self._stepper.at
            self.health.skipped = self._stepper.skipped + getattr(self._stepper.core, "skipped", 0)
        return True

    def _publish(self, outputs: list[Output]) -> None:
        encoded = []
        for output in outputs:  # all before the first is sent: a step is published as a whole or not at all
            try:
                encoded.append(encode(output.message))
            except MessageError as error:
                raise MessageError(f"gives an invalid {output.topic.name}: {error}") from error
        for output, payload in zip(outputs, encoded, strict=True):
            self.outbox.keep(output.topic, output.part, output.message, payload)
            self._bus.publish(output.topic, output.part, payload)
            self.health.published += 1


def run_local(pairs: Sequence[tuple[Service, Core]], parts: tuple[str, ...], run_id: str,
              episodes: Iterable[int] | None = None, on_message: OnMessage | None = None, *, encoded: bool = False,
              on_step: OnStep | None = None) -> None:
    """Runs the cores in this process: those episodes of the source (the core with `episodes`), in rising order; or all.

    `on_message(topic, part, message, payload)` sees every message in the order of publication; payload is its wire
    bytes if `encoded`, else None, and messages pass as they are. A source that goes by time is not hurried: its next
    frame comes when the one before it has been worked off. `on_step(service, milliseconds)` is told what each
    step of a core took. Raises SaccadeError if a step lacks an input for good.
    """
    sources = [Stepper(s, c, parts, source=True) for s, c in pairs if hasattr(c, "episodes")]
    if len(sources) != 1:
        raise SaccadeError(f"a run needs one source, not {len(sources)}: {', '.join(s.name for s, _ in pairs)}")
    source = sources[0]
    steppers = [source if c is source.core else Stepper(s, c, parts) for s, c in pairs]
    for episode in range(source.core.episodes) if episodes is None else episodes:
        waiting = deque(source.begin(run_id, episode))
        while waiting or (source.timed and not source.episode_done):
            if not waiting:  # the frame before it has been worked off
                waiting.extend(source.tick())
                continue
            output = waiting.popleft()
            message = settle(output.message)
            if on_message is not None:
                on_message(output.topic, output.part, message, encode(message) if encoded else None)
            for stepper in steppers:
                if output.topic not in stepper.service.inputs:
                    continue
                stepper.offer(output.topic, output.part, message)
                while (outputs := _advance(stepper, on_step)) is not None:
                    waiting.extend(outputs)
        if not source.episode_done:
            lacks = [f"{s.service.name} {WAITS}{', '.join(s.waits_for())}" for s in steppers if s.waits_for()]
            raise SaccadeError(f"episode {episode} came to a halt: {'; '.join(lacks) or 'nobody has anything to do'}")


def _advance(stepper: Stepper, on_step: OnStep | None) -> list[Output] | None:
    start = time.perf_counter()
    outputs = stepper.advance()
    if outputs is not None and on_step is not None:
        on_step(stepper.service.name, (time.perf_counter() - start) * 1e3)
    return outputs
