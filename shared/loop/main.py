"""The main loop, which every service uses."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import STATUS, Output, Topic
from saccade.shared.bus.transport import Bus, ZenohBus
from saccade.shared.bus.wire import MessageError, decode, encode, stamp_of
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.episodes import RECORDER, Episodes, stranger
from saccade.shared.loop.modules import ServiceModule, load
from saccade.shared.loop.process import DRAIN_S, Health, Heartbeat, Inbox, run_process
from saccade.shared.loop.replicas import JOIN_S, MEET_S, Share, alone_on
from saccade.shared.loop.service import Core, Service
from saccade.shared.loop.stepper import Stepper
from saccade.shared.loop.ticker import Ticker

IDLE_S = 1.0  # after this time without a message a service asks for what it lacks, and says so
WAITS = "waits for "


def main(name: str, argv: Sequence[str] | None = None) -> None:
    """The process of a service: it reads `--config RUN/config.json`, then takes and publishes messages until SIGTERM.

    The configuration can put a module from outside in the place of the service `name`. If the input is wrong, the
    process prints one line and ends with exit code 2.
    """
    def work(config: Config, folder: Path, inbox: Inbox) -> None:
        _work(load(name, config, compare=False), config, folder, inbox)

    run_process(name, work, argv=argv)


def run_module(module: ServiceModule, argv: Sequence[str] | None = None) -> None:
    """Does the same as `main` for a service that the configuration does not name."""
    run_process(module.service.name, lambda config, folder, inbox: _work(module, config, folder, inbox), argv=argv)


def _work(module: ServiceModule, config: Config, folder: Path, inbox: Inbox) -> None:
    names, core = config.names, module.build(config)
    bus = ZenohBus(config.bus.endpoint, world=config.bus.world)
    try:
        serve(module.service, core, bus, names, run=config.run or folder.name,
              wait_for=config.bus.wait_for, inbox=inbox, live=config.bus.live, first_step=config.bus.first_step)
    finally:
        bus.close()


def serve(service: Service, core: Core, bus: Bus, parts: tuple[str, ...], *, run: str,
          wait_for: tuple[str, ...] = (), inbox: Inbox | None = None, live: bool = False,
          first_step: int = 0) -> Health:
    """Runs a core on a bus until `inbox` is stopped. Returns what the service has counted.

    A source, which is a core with `episodes`, begins its episodes itself. It begins the first one when every service in
    `wait_for` is ready. A source that goes by time publishes one frame per period.

    The service asks for messages that were published before it was there, or while it or the router was away. It does
    so at the start and whenever nothing arrives. So a service that was started again repeats the episode so far and
    continues. With `live` it continues with the newest step instead.
    """
    inbox, source = inbox or Inbox(), hasattr(core, "episodes")
    stepper = Stepper(service, core, parts, source=source, live=live, first_step=first_step, run=run)
    loop = _Loop(stepper, bus, run, wait_for if source else (), live=live)
    bus.answer(service.outputs, loop.outbox.answer)
    bus.subscribe(loop.topics + ((STATUS,) if source and wait_for else ()) + loop.watched, inbox.put)
    loop.join(inbox)
    with Heartbeat(bus, loop.health, inbox.stop):
        loop.health.say("ready", WAITS + ", ".join(sorted(loop.awaited)) if loop.awaited else loop.notes)
        loop.begin_if_due()
        loop.catch_up()
        news_s = time.monotonic()
        for item in inbox.items(0.0 if source else DRAIN_S, IDLE_S, lambda: loop.wait_s):
            if item is not None:
                loop.handle(*item, more=loop.looks_ahead and inbox.waiting)
            elif loop.looks_ahead:
                loop.work_off(service.trigger)
            if not inbox.stopping.is_set():
                loop.tick_if_due()
                loop.share_if_due()
            if item is not None and item[0] != STATUS:
                news_s = time.monotonic()
            elif time.monotonic() - news_s >= IDLE_S:
                loop.catch_up()
                loop.say_what_lacks()
                news_s = time.monotonic()  # now: whoever never answers takes as long as may be waited for
    return loop.health


class _Loop:
    """What a service does with each message."""

    def __init__(self, stepper: Stepper, bus: Bus, run: str, wait_for: tuple[str, ...], *, live: bool) -> None:
        service, core = stepper.service, stepper.core
        self.health, self.outbox = Health(service.name), Outbox()
        self.topics = service.inputs + ((service.closed_by,) if service.closed_by else ())
        self._source = stepper.episode_done  # a source begins between two episodes
        self._stepper, self._bus, self._run, self._service = stepper, bus, run, service
        self.notes = "\n".join(getattr(core, "notes", ()))
        self._ticker = Ticker(core.period_s) if stepper.timed else None
        self._live, self._sequences = live, Sequences()
        share = self._share = Share(service, stepper.parts) if service.divisible and not live else None
        if share:
            stepper.is_due = lambda at: share.lacks(core.names, at)
        self._episodes = Episodes(core.episodes if self._source else 0, run, wait_for,
                                  closed=service.closed_by is not None, timed=stepper.timed)
        self._refused: set[Topic] = set()

    @property
    def awaited(self) -> set[str]:
        """The services that a source still waits for."""
        return self._episodes.awaited

    @property
    def watched(self) -> tuple[Topic, ...]:
        """The outputs of this service, if it has replicas. What one replica has answered, the others do not answer."""
        return self._service.outputs if self._share else ()

    @property
    def looks_ahead(self) -> bool:
        """Whether the service looks at everything that has arrived before it takes a step."""
        return self._live or self._share is not None

    def join(self, inbox: Inbox) -> None:
        """Meets the replicas of this service if it can be shared. A source must be alone: raises SaccadeError if this
        is a source and another one is there."""
        if self._share:
            self._share.meet(self._bus, inbox.wake)
            inbox.stopping.wait(MEET_S)
            if self._share.changed:
                inbox.stopping.wait(JOIN_S)
                self.share_if_due()
        elif self._source:
            alone_on(self._bus, self._service.name)

    def share_if_due(self) -> None:
        """Takes over objects from a replica that is gone, and gives objects to one that has come."""
        if not self._share or not self._share.changed:
            return
        before, core = set(self._stepper.core.names), self._stepper.core
        core.share(self._share.take_mine())
        if set(core.names) - before:
            self._step(self._service.trigger, None, self._stepper.again)
        whole = core.names == self._stepper.parts
        self.notes = "" if whole else f"answers for {', '.join(core.names) or 'nothing'}"
        self.health.say(note=self.notes)

    def handle(self, topic: Topic, part: str | None, payload: bytes, *, more: bool = False) -> None:
        """Takes a message. Runs the core for every complete step, unless there are `more` messages to look at first."""
        if topic == STATUS:
            self._note_status(part, payload)
            return
        if topic in self.watched:
            self._note_answer(topic, part, payload)
        else:
            self._take(topic, part, payload)
        if not more:
            self.work_off(topic, part)

    def work_off(self, topic: Topic, part: str | None = None) -> None:
        """Runs the core for every step that is complete."""
        while self._step(topic, part, self._stepper.advance):
            self.begin_if_due()

    def _note_answer(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Keeps what another replica has said, so that others can ask for it here if that replica dies. A payload that
        is not a message is ignored."""
        with suppress(MessageError):
            if self._share and not self._share.is_answered(topic, part, stamp_of(payload)):
                message = decode(topic.type, payload)
                self._share.answered(topic, part, message)
                self.outbox.keep(topic, part, message, payload)

    def _take(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self.health.received += 1
        try:
            message = decode(topic.type, payload)
            if topic == self._service.closed_by:
                self._episodes.close(message)
            else:
                self._stepper.offer(topic, part, message)
            self.health.gaps += self._sequences.take(topic, part, message) or 0
            if topic == self._service.closed_by:
                self.begin_if_due()
        except MessageError as error:
            self._refuse(topic, part, error)

    def _refuse(self, topic: Topic, part: str | None, reason: object) -> None:
        self.health.refuse(topic, part, reason)
        if topic not in self._refused:  # printed once per topic, for the log of the process
            self._refused.add(topic)
            print(f"saccade: {self.health.service}: {self.health.note}", file=sys.stderr, flush=True)

    def begin_if_due(self) -> None:
        """Begins a source's next episode if all services are ready and the last episode is over and closed."""
        while self._source and self._stepper.episode_done and self._episodes.may_begin:
            episode = self._episodes.begin()
            if episode is None:
                self.health.say("finished")
                return
            self._step(None, None, partial(self._stepper.begin, self._run, episode))
            if self._ticker:
                self._ticker.start()

    def tick_if_due(self) -> None:
        """Publishes the next frame of a source that goes by time, if it is due."""
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
        """Asks for inputs that were published and have not arrived, until the answers complete no further step. In live
        mode it asks only for latched messages, because past steps do not count there."""
        latched = [topic for topic in self.topics if topic.latched and topic != self._service.closed_by]
        others = [topic for topic in self.topics if topic not in latched and not self._live]
        while not self.awaited:
            wants = self._stepper.wants
            episode = wants and (*wants[:2], 0)
            kept = self._bus.recall((*self.watched, *latched), episode) + self._bus.recall(others, wants)
            for topic, part, payload, *_ in kept:
                self.handle(topic, part, payload)
            if self._stepper.wants == wants:
                return

    def say_what_lacks(self) -> None:
        """Writes into the status which inputs the next step still needs. It is called when nothing has arrived for a
        while."""
        if lacks := self._stepper.waits_for():
            self.health.say(note=WAITS + ", ".join(lacks))

    def _note_status(self, part: str | None, payload: bytes) -> None:
        awaited = bool(self.awaited)
        if not awaited and part != RECORDER:
            return
        try:
            status = decode(STATUS.type, payload)
        except MessageError:
            return  # the service that sent it does not count as ready
        if (reason := stranger(status, part, self._run)) is not None:
            self._refuse(STATUS, part, reason)
        elif self._episodes.heard(part, status):
            if awaited:
                self.health.say(note=self.notes)
            self.begin_if_due()
            if awaited:
                self.catch_up()

    def _step(self, topic: Topic | None, part: str | None, make: Callable[[], list[Output] | None]) -> bool:
        """Runs the core once and publishes its outputs. Returns whether there was anything to do."""
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
                raise SaccadeError(f"{name} cannot begin episode {self._episodes.current}: {error}") from error
            self.health.refuse(topic, part, error)
        finally:
            self.health.state = before
            self.health.at = self._stepper.at
            self.health.skipped = self._stepper.skipped + getattr(self._stepper.core, "skipped", 0)
            self.health.unusable = getattr(self._stepper.core, "refused", 0)
        return True

    def _publish(self, outputs: list[Output]) -> None:
        if self._share:
            outputs = [o for o in outputs if not self._share.is_answered(o.topic, o.part, o.message)]
        encoded = []
        for output in outputs:  # all, before the first is sent: a step is published whole or not at all
            try:
                encoded.append(encode(output.message))
            except MessageError as error:
                said = f"gives an invalid {output.topic.name}: {error}"
                if self._live:
                    raise MessageError(said) from error
                raise SaccadeError(f"{self.health.service} {said}; the run cannot go on without it") from error
        for output, payload in zip(outputs, encoded, strict=True):
            self.outbox.keep(output.topic, output.part, output.message, payload)
            if self._share:
                self._share.answered(output.topic, output.part, output.message)
            self._bus.publish(output.topic, output.part, payload)
            self.health.published += 1
