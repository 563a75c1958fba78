"""What surrounds the work of every service process: arguments, signals, heartbeat and exit code."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from saccade.shared.bus.messages import Message, Status
from saccade.shared.bus.topics import STATUS, Topic
from saccade.shared.bus.transport import Bus
from saccade.shared.bus.wire import MessageError, decode, encode
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError

HEARTBEAT_S = 0.5
SHORTEST_S = 0.05  # shortest time between two statuses, however many messages are refused
# A service that is told to stop first works off the messages that are already on their way. It ends when nothing has
# arrived for QUIET_S, or after DRAIN_S in all.
QUIET_S = 0.1
DRAIN_S = 1.0
EXIT_ERROR = 2
NOTE_LENGTH = 1000
MOST_COUNTED = 2 ** 63 - 1  # the largest number that a message can hold
REFUSED = "refused: "
STARTING = "starting"
HEARTBEAT_VARIABLE = "SACCADE_HEARTBEAT"  # names a file whose age and text show the state to others
LAUNCHER_VARIABLE = "SACCADE_LAUNCHER"  # the launcher's process id; the service stops if it loses this parent

Item = tuple[Topic, str | None, bytes]


class Inbox:
    """Hands items from the bus's thread to the main thread. If it holds `limit_bytes`, it drops new items and counts
    them."""

    def __init__(self, limit_bytes: int | None = None) -> None:
        self.stopping = threading.Event()
        self.dropped = 0
        self._limit, self._held, self._lock = limit_bytes, 0, threading.Lock()
        self._queue: queue.SimpleQueue[Item | None] = queue.SimpleQueue()

    def put(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Adds an item. It is made for `Bus.subscribe` and never blocks."""
        with self._lock:
            if self._limit is not None and self._held + len(payload) > self._limit:
                self.dropped += 1
                return
            self._held += len(payload)
        self._queue.put((topic, part, payload))

    def stop(self) -> None:
        """Makes `get` return None, and ends `items`. It may be called in a signal handler."""
        self.stopping.set()
        self._queue.put(None)

    def get(self, timeout_s: float | None = None) -> Item | None:
        """Returns the next item. Returns None after `timeout_s` seconds without one, or if `stop` was called."""
        with contextlib.suppress(queue.Empty):
            item = self._queue.get(timeout=timeout_s)
            if item is not None:
                with self._lock:
                    self._held -= len(item[2])
            return item
        return None

    def wake(self) -> None:
        """Makes `items` yield None soon, if it has a `tick_s`."""
        self._queue.put(None)

    @property
    def waiting(self) -> bool:
        """Whether an item is there to be taken."""
        return not self._queue.empty()

    def items(self, drain_s: float = DRAIN_S, tick_s: float | None = None,
              wait_s: Callable[[], float] = lambda: math.inf) -> Iterator[Item | None]:
        """Yields every item until `stop`, and after it those that follow without a pause, for at most `drain_s`
        seconds.

        With `tick_s` it also yields None whenever nothing has arrived for `tick_s` seconds, or for `wait_s()` seconds
        if that is less.
        """
        while True:
            item = self.get(None if tick_s is None else min(tick_s, wait_s()))
            if item is None and self.stopping.is_set():
                break  # everything that came before `stop` has been taken, except after a tick at that very moment
            if item is not None or tick_s is not None:
                yield item
        end = time.monotonic() + drain_s
        while time.monotonic() < end and (item := self.get(QUIET_S)) is not None:
            yield item


@dataclass
class Health:
    """What a service says about itself. Its main thread writes these plain numbers, and the heartbeat reads them."""

    service: str
    state: str = STARTING
    note: str = ""
    at: tuple[str, int, int] = ("", 0, 0)  # run, episode, step
    received: int = 0
    published: int = 0
    refused: int = 0
    unusable: int = 0  # messages from elsewhere that a source could not use; they count as refused
    skipped: int = 0
    gaps: int = 0
    milliseconds: float = 0.0
    changed: threading.Event = field(default_factory=threading.Event)

    def say(self, state: str | None = None, note: str | None = None) -> None:
        """Changes the state or the note. The heartbeat publishes the change soon."""
        self.state = self.state if state is None else state
        self.note = self.note if note is None else note[:NOTE_LENGTH]
        self.changed.set()

    def refuse(self, topic: Topic, part: str | None, reason: object) -> None:
        """Counts a message that is not valid, and puts the reason into the note."""
        self.refused += 1
        self.say(note=f"{REFUSED}{topic.name}{f'/{part}' if part else ''}: {reason}")

    def status(self, seq: int) -> Status:
        """Returns the status message for the bus."""
        run, episode, step = self.at
        counted = {name: min(getattr(self, name), MOST_COUNTED)
                   for name in ("received", "published", "skipped", "gaps")}
        counted["refused"] = min(self.refused + self.unusable, MOST_COUNTED)
        return Status(run=run, episode=episode, step=step, seq=seq, service=self.service, state=self.state, **counted,
                      milliseconds=self.milliseconds, note=self.note)


class Heartbeat:
    """Publishes a Health every half second, and at once when it changes. It does so even while the main thread is busy.

    Calls `on_orphaned` if the launcher that started this process is gone.
    """

    def __init__(self, bus: Bus, health: Health, on_orphaned: Callable[[], None] = lambda: None) -> None:
        self._bus, self._health, self._on_orphaned = bus, health, on_orphaned
        self._stop = threading.Event()
        self._seq = 0
        health.changed.set()  # it tells the first state at once
        self._parent, self._file = os.environ.get(LAUNCHER_VARIABLE), os.environ.get(HEARTBEAT_VARIABLE)
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._health.state = "stopped" if kind is None else "failed"
        self._stop.set()
        self._health.changed.set()
        self._thread.join(timeout=2.0)
        self._publish()

    def _run(self) -> None:
        while not self._stop.wait(SHORTEST_S):
            self._health.changed.wait(HEARTBEAT_S)
            self._health.changed.clear()
            self._publish()
            if self._parent is not None and str(os.getppid()) != self._parent:
                self._on_orphaned()

    def _publish(self) -> None:
        if self._file:
            with contextlib.suppress(OSError):  # a reader of the file sees that it grows old
                Path(self._file).write_text(self._health.state)
        self._bus.publish(STATUS, self._health.service, self._encoded())
        self._seq += 1

    def _encoded(self) -> bytes:
        """The status. If something in it cannot be told, the state is told with the reason: a service that is not
        heard is taken for one that hangs."""
        status = self._health.status(self._seq)
        try:
            return encode(status)
        except MessageError as error:
            return encode(Status(run="", episode=0, step=0, seq=self._seq, service=status.service, state=status.state,
                                 note=f"its status cannot be told: {error}"))


def messages_of(inbox: Inbox, health: Health) -> Iterator[tuple[Topic, str | None, Message]]:
    """Yields the messages of the run that `health` names, or of all if it names none, with their topics and parts,
    until the inbox is stopped. It counts what is received. It is for onlookers: what is malformed is passed over,
    because the services that compute with the message count it as refused."""
    run = health.at[0]
    for topic, part, payload in filter(None, inbox.items(drain_s=0.0)):
        health.received += 1
        try:
            message = decode(topic.type, payload)
        except MessageError:
            continue
        if not run or message.run == run:
            yield topic, part, message


def run_process(name: str, work: Callable[[Config, Path, Inbox], None], *, inbox: Inbox | None = None,
                argv: Sequence[str] | None = None) -> None:
    """Calls `work(config, folder, inbox)` between the command line and the exit code. `folder` is the folder of the
    configuration file.

    The first SIGTERM or SIGINT stops the inbox, a second one ends the process at once. SaccadeError is printed as one
    line on stderr, with exit code 2.
    """
    parser = argparse.ArgumentParser(prog=f"python -m services.{name}", description=f"Saccade's {name} service.")
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="configuration of the run (JSON)")
    arguments = parser.parse_args(argv)
    inbox = inbox or Inbox()

    def on_signal(number: int, _frame: object) -> None:
        if inbox.stopping.is_set():
            os._exit(128 + number)
        inbox.stop()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        work(load(arguments.config), arguments.config.resolve().parent, inbox)
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr, flush=True)
        sys.exit(EXIT_ERROR)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
