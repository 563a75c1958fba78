"""Listening to messages from outside, on the bus of a run or in a log. A run never waits for a listener."""

from __future__ import annotations

import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from saccade.shared.bus.topics import ROOT, TOPICS, Topic
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.process import Inbox

RUNS = Path("runs")
QUEUE_BYTES = 64 * 1024 * 1024  # for messages that wait to be shown; what does not fit is dropped
TICK_S = 0.2
CONNECT_S = 3.0
PROBE_S = 0.3
NEWEST = 20  # so many run folders are tried, the newest first


class Heard(NamedTuple):
    """A message as it was on the bus, and the time at which it came (ns)."""

    topic: Topic
    part: str | None
    payload: bytes
    time_ns: int


@dataclass(frozen=True)
class Wanted:
    """The keys that are listened to; `*` stands for anything. `world` is None if the user did not name one."""

    topic: str
    part: str
    world: str | None = None

    @classmethod
    def parse(cls, key: str) -> Wanted:
        """Reads a full key, or topic[/part]. Raises SaccadeError if it cannot match any key of Saccade."""
        pieces = key.split("/")
        world = None
        if pieces[0] == ROOT and len(pieces) > 2:
            world, pieces = pieces[1], pieces[2:]
        wanted = cls(pieces[0], "/".join(pieces[1:]) or "*", world)
        if not wanted.topics or not re.fullmatch(r"\*|[A-Za-z0-9_-]{1,64}", world or "*"):
            raise SaccadeError(f"key {key!r} is none of Saccade's: give {ROOT}/<world>/<topic>[/<part>] or "
                               f"<topic>[/<part>] with a topic of {', '.join(TOPICS)}; * stands for any")
        return wanted

    @property
    def topics(self) -> list[Topic]:
        """The topics that it can match."""
        return [topic for topic in TOPICS.values()
                if fnmatchcase(topic.name, self.topic) and (topic.parts or self.part in ("*", "**"))]

    def matches(self, topic: Topic, part: str | None) -> bool:
        """Whether it matches this key."""
        return topic in self.topics and (part is None or fnmatchcase(part, self.part))


class Live:
    """The messages of a bus while they are published. They are copied into a queue. If the queue is full, new messages
    are dropped and counted.

    `endpoint` is the address of the bus. Raises SaccadeError if nothing answers there.
    """

    def __init__(self, wanted: Wanted, endpoint: str, world: str, limit_bytes: int = QUEUE_BYTES) -> None:
        self.wanted, self.world, self.inbox = wanted, world, Inbox(limit_bytes)
        self._bus = ZenohBus(endpoint, world=world, onlooker=True, timeout_s=CONNECT_S)

    @property
    def dropped(self) -> int:
        """How many messages came while the queue was full."""
        return self.inbox.dropped

    def heard(self) -> Iterator[Heard | None]:
        """Yields messages from now on until `stop`, and None from time to time while nothing comes. The first ones are
        messages that hold for the whole episode and were published before."""
        self.listen(self._put)
        known = set()
        for heard in self.earlier():
            known.add(heard.payload)
            yield heard
        while not self.inbox.stopping.is_set():
            item = self.inbox.get(TICK_S)
            if item is None:
                yield None
            elif not item[0].latched or item[2] not in known:
                yield Heard(*item, time.time_ns())

    def earlier(self) -> list[Heard]:
        """Asks the publishers for the messages that hold for the whole episode and were published before."""
        kept = self._bus.recall([topic for topic in self.wanted.topics if topic.latched])
        return [Heard(k.topic, k.part, k.payload, k.published_ns) for k in kept if self.wanted.matches(k.topic, k.part)]

    def listen(self, deliver: Callable[[Topic, str | None, bytes], None]) -> None:
        """Calls `deliver` for every wanted message, on the bus's thread. `deliver` must not wait."""
        def take(topic: Topic, part: str | None, payload: bytes) -> None:
            if self.wanted.matches(topic, part):
                deliver(topic, part, payload)

        self._bus.subscribe(self.wanted.topics, take)

    def stop(self) -> None:
        """Ends `heard`. It is safe in a signal handler."""
        self.inbox.stop()

    def close(self) -> None:
        """Leaves the bus."""
        self._bus.close()

    def _put(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self.inbox.put(topic, part, payload)


class Logged:
    """The messages of a log. Its `world` is known after the first message. Raises SaccadeError if the file is not a
    log."""

    dropped = 0

    def __init__(self, wanted: Wanted, log: Path) -> None:
        self.wanted, self.reader = wanted, RunReader(log)

    @property
    def world(self) -> str:
        """The world of the log."""
        return self.reader.world

    def heard(self) -> Iterator[Heard]:
        """Yields the messages from the first to the last. Raises SaccadeError if the log is not of the wanted world."""
        for entry in self.reader.entries():
            if not fnmatchcase(self.world, self.wanted.world or "*"):
                raise SaccadeError(f"log {self.reader.path} is of world {self.world!r}, not {self.wanted.world!r}")
            if self.wanted.matches(entry.topic, entry.part):
                yield Heard(*entry)


def live(wanted: Wanted, *, endpoint: str | None, run: Path | None) -> Live:
    """Listens to a run that is going on; `config_of` says to which. Raises SaccadeError if there is none."""
    bus = config_of(endpoint=endpoint, run=run).bus
    return Live(wanted, bus.endpoint, bus.world if wanted.world in (None, "*") else wanted.world)


def config_of(*, endpoint: str | None, run: Path | None) -> Config:
    """Returns the configuration of the run in a folder, or of the newest run whose bus answers. If only an endpoint is
    given, nothing else is known about the run. Raises SaccadeError if there is no such run, or if both are given."""
    if endpoint is not None and run is not None:
        raise SaccadeError("--endpoint and --run both name a bus: give one of them")
    if endpoint is not None:
        return Config().with_values({"bus.endpoint": endpoint})
    folder = run or newest_run()
    return on_bus(folder).with_values({"run": folder.resolve().name})


def on_bus(run: Path) -> Config:
    """Returns the configuration in a run's folder. Raises SaccadeError if the run had no bus."""
    config = load(run / CONFIG_NAME)
    if config.bus.kind != "zenoh" or config.bus.endpoint.endswith(":0"):
        raise SaccadeError(f"run {run} was within one process and has no bus: give its log with --log")
    return config


def newest_run(runs: Path = RUNS) -> Path:
    """Returns the folder of the newest run whose bus answers. Raises SaccadeError if there is none."""
    with suppress(OSError):
        folders = sorted((path.stat().st_mtime_ns, path.parent) for path in runs.glob(f"*/{CONFIG_NAME}"))
        for _, folder in folders[:-NEWEST - 1:-1]:
            with suppress(SaccadeError):
                if answers(on_bus(folder).bus.endpoint):
                    return folder
    raise SaccadeError(f"no run in {runs.absolute()} is on a bus now: give --endpoint, --run or --log")


def answers(endpoint: str) -> bool:
    """Whether something listens at a TCP endpoint."""
    match = re.fullmatch(r"tcp/\[?([^\[\]]+)\]?:(\d+)", endpoint)
    with suppress(OSError, OverflowError), socket.create_connection((match[1], int(match[2])) if match else ("", 0),
                                                                    timeout=PROBE_S):
        return True
    return False


@contextmanager
def until_interrupted(stop: Callable[[], None]) -> Iterator[None]:
    """Within this context, Ctrl-C and SIGTERM call `stop`. A second signal ends the process at once."""
    def on_signal(number: int, _frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        stop()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
