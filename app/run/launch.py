"""Starts a whole agent on this machine: the bus and one process for each service. It ends them when the run is over."""

from __future__ import annotations

import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from saccade.app.run.halt import Pulse
from saccade.app.run.supervisor import Process, Supervisor
from saccade.services.recorder.core import complete
from saccade.shared.bus.messages import Message, Result, Status
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import PLAN, RESULT, STATUS, Topic
from saccade.shared.bus.transport import Bus, ZenohBus, free_endpoint
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.config import Config
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable
from saccade.shared.log.folder import CONFIG_NAME, LOG_NAME, LOGS_NAME
from saccade.shared.log.reading import is_whole
from saccade.shared.loop.main import READY_STATES
from saccade.shared.loop.process import Item
from saccade.shared.render.objects import names_of

Told = tuple[Topic, str | None, Message]
OnMessage = Callable[[Topic, str | None, Message], None]
FOLLOWED = (STATUS, PLAN, RESULT)  # these topics tell the launcher how far a run is
READY_S = 120.0  # on a busy machine it takes long to load weights
CONNECT_S = 10.0  # a router on this machine answers at once
POLL_S = 0.2
MOST_STRANGERS = 20  # other runs that are named
# After so long without news the launcher asks for results: one may have been published while the router was away.
QUIET_S = 2.0
WORKED_OFF_S = 10.0  # If nobody judges: after so long without news the plan for the last frame will not come any more.
JUDGE, RECORDER = "evaluator", "recorder"

# The router, then the others in the order in which the data passes them.
ROUTER, *SERVICES = PROCESSES = tuple(Process(name, f"saccade.services.{name}") for name in (
    "router", "simulator", "perception", "belief", "planner", JUDGE, RECORDER))


def launch(config: Config, run_dir: Path, on_message: OnMessage | None = None,
           processes: Sequence[Process] = PROCESSES, say: Callable[[str], None] | None = None,
           topics: Sequence[Topic] | None = None) -> list[Result]:
    """Runs all episodes like `launched`, stops the onlookers too when the run is over, and returns the results."""
    with launched(config, run_dir, on_message, processes, say, topics) as ended:
        return ended.results


@dataclass(frozen=True)
class Ended:
    """A run that is over: its results; `runs(name)`, which says whether the process of an onlooker is still there; and
    what did not end well, such as a log that lacks a part."""

    results: list[Result]
    runs: Callable[[str], bool]
    lacks: tuple[str, ...] = ()


@contextmanager
def launched(config: Config, run_dir: Path, on_message: OnMessage | None = None,
             processes: Sequence[Process] = PROCESSES, say: Callable[[str], None] | None = None,
             topics: Sequence[Topic] | None = None) -> Iterator[Ended]:
    """Runs all episodes, with one process for each service. Yields their results in order; there are none if nobody
    judges. The log is `run_dir`/run.mcap. A run ends when its source has finished and everything that the source sent
    has been worked off. Onlookers stay until the context is left.

    `on_message(topic, part, message)` sees every valid message of these topics once, on the caller's thread; without
    `topics` it sees all. Topics that nobody wants cost nothing. `say(text)` is told of services that died and were
    started again, and of those that hang. The first process is the router, the second is the source. Raises
    SaccadeError, which names the service, if a service says why it cannot run, dies too often, or is not ready within
    READY_S.
    """
    config = resolve(config, processes)
    wanted = topics if on_message else ()
    with running(config, run_dir, processes, wanted if wanted is None else {*wanted, *FOLLOWED}, say) as graph:
        results = follow(graph.messages, graph.supervisor, processes, on_message, live=config.bus.live)
        graph.supervisor.stop(onlookers=False)
        _drain(graph.messages, on_message)
        lacks = graph.supervisor.complaints()  # such as a full disk
        if graph.supervisor.was_killed(RECORDER) and not is_whole(run_dir / LOG_NAME):
            complete(run_dir, config)
            lacks.append(f"the recorder was killed before it had closed {run_dir / LOG_NAME}: the log has its index "
                         "now, and `saccade log check` says what it lacks")
        for complaint in lacks:
            print(f"saccade: {printable(complaint, LINE_LIMIT)}", file=sys.stderr)
        yield Ended(results, graph.supervisor.runs, tuple(lacks))


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


@dataclass(frozen=True)
class Graph:
    """Processes that run, and a client on their bus. `messages` yields (topic, part, message) as they arrive, each
    once, and None when nothing arrived. While it is iterated, the processes are watched."""

    bus: Bus
    supervisor: Supervisor
    messages: Iterator[Told | None]


@contextmanager
def running(config: Config, run_dir: Path, processes: Sequence[Process], topics: Iterable[Topic] | None,
            say: Callable[[str], None] | None = None) -> Iterator[Graph]:
    """Starts the processes of a resolved configuration in a new run folder, and ends them when the context is left. The
    first one is the router; it is ready before the others start. `topics` are the wanted topics, None for all. Raises
    SaccadeError if the folder cannot be used, or if a process cannot run."""
    _prepare(run_dir)
    config.save(run_dir / CONFIG_NAME)
    arrived: queue.SimpleQueue[Item] = queue.SimpleQueue()
    with ExitStack() as stack:
        stack.enter_context(_terminable())
        say = say or (lambda text: print(f"saccade: {printable(text)}", file=sys.stderr))
        supervisor = Supervisor(run_dir, say)
        stack.callback(supervisor.stop)
        supervisor.start(processes[0])
        bus = _connected(config, supervisor)
        stack.callback(bus.close)
        bus.subscribe(topics, lambda *item: arrived.put(item))
        stream = messages(arrived, bus, supervisor, config.run or run_dir.name, say)
        _await_router(stream, processes[0])
        for process in processes[1:]:
            supervisor.start(process)
        yield Graph(bus, supervisor, stream)


def _connected(config: Config, supervisor: Supervisor) -> ZenohBus:
    """A client on the bus of a router that was just started. It is watched meanwhile: who died is started again. Raises
    SaccadeError with the router's own reason if it cannot run, or if it does not answer within CONNECT_S."""
    deadline_s = time.monotonic() + CONNECT_S
    while True:
        try:
            return ZenohBus(config.bus.endpoint, world=config.bus.world, timeout_s=CONNECT_S / 5)
        except SaccadeError:
            supervisor.check()
            if time.monotonic() > deadline_s:
                raise


def resolve(config: Config, processes: Sequence[Process] = PROCESSES) -> Config:
    """Returns the configuration that the processes read: with the names of the objects, a free port, and the names of
    the services that must be ready first. Raises SaccadeError if the object set is unknown."""
    names = config.scene.names or names_of(config.scene.objects)
    return config.with_values({"bus.endpoint": free_endpoint(config.bus.endpoint), "scene.names": list(names),
                               "bus.wait_for": [process.name for process in processes[2:] if not process.onlooker]})


def _prepare(run_dir: Path) -> None:
    if (run_dir / LOG_NAME).exists():
        raise SaccadeError(f"run folder {run_dir} already holds a log; choose another, or move it away")
    try:
        (run_dir / LOGS_NAME).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SaccadeError(f"run folder {run_dir} cannot be made: {error.strerror}") from error


def messages(arrived: queue.SimpleQueue[Item], bus: Bus, watch: Watch, run: str,
             say: Callable[[str], None]) -> Iterator[Told | None]:
    """Yields (topic, part, message) as they arrive, each once, and None when nothing arrived. Messages of other runs
    are ignored; `say` is told of each such run once."""
    strangers: set[str] = set()
    sequences, looked_s, news_s = Sequences(), time.monotonic(), time.monotonic()
    while True:
        now_s = time.monotonic()
        if now_s - looked_s >= POLL_S:
            looked_s = now_s
            watch.check()
        if now_s - news_s >= QUIET_S and not watch.stopped:
            news_s = now_s
            for topic, part, payload, *_ in bus.recall((RESULT,), (run, 0, 0)):
                arrived.put((topic, part, payload))
        item: Told | None = None
        with suppress(queue.Empty, MessageError):  # a service that gets an invalid message counts it
            topic, part, payload = arrived.get(timeout=POLL_S)
            message = decode(topic.type, payload)
            if isinstance(message, Status):
                if part is not None:
                    watch.heard(part, message.state)
            elif message.run != run:
                if message.run not in strangers and len(strangers) < MOST_STRANGERS:
                    strangers.add(message.run)
                    say(f"a {topic.name} of another run, {message.run!r}, came on the bus: such messages are ignored")
                continue
            if sequences.take(topic, part, message) is not None:
                item = (topic, part, message)
                news_s = news_s if topic == STATUS else now_s
        yield item


def _await_router(messages: Iterator[Told | None], router: Process) -> None:
    deadline_s = time.monotonic() + READY_S
    for item in messages:
        if item and item[1] == router.name and isinstance(item[2], Status) and item[2].state in READY_STATES:
            return
        if time.monotonic() > deadline_s:
            raise SaccadeError(f"{router.name}: not ready after {READY_S:.0f} s; see {LOGS_NAME}/")


def follow(told: Iterable[Told | None], watch: Watch, processes: Sequence[Process],
           on_message: OnMessage | None, *, live: bool) -> list[Result]:
    """Follows a run until it is over, and returns its results in the order of the episodes. Raises SaccadeError if a
    service is not ready within READY_S, or if all services wait for one another; `live`, they may wait for a camera."""
    starting = {process.name for process in processes[1:] if not process.onlooker}
    pulse = Pulse(set() if live else set(starting))
    course = _Course(processes[1].name, judged=JUDGE in starting)
    over_s, deadline_s = None, time.monotonic() + READY_S
    for item in told:
        if starting and time.monotonic() > deadline_s:
            raise SaccadeError(f"{', '.join(sorted(starting))}: not ready after {READY_S:.0f} s; see {LOGS_NAME}/")
        over_s = (over_s or time.monotonic()) if course.over else None
        if over_s is not None and watch.settled(over_s):
            break
        if over_s is None and (why := pulse.halted()):
            raise SaccadeError(why)
        if item is None:
            continue
        topic, part, message = item
        if on_message is not None:
            on_message(topic, part, message)
        course.take(topic, part, message)
        pulse.take(topic, part, message)
        if isinstance(message, Status) and part is not None and message.state in READY_STATES:
            starting.discard(part)
    return [course.results[episode] for episode in sorted(course.results)]


class _Course:
    """Keeps track of how far a run has come."""

    def __init__(self, source: str, *, judged: bool) -> None:
        self.results: dict[int, Result] = {}
        self._source, self._judged = source, judged
        self._end: tuple[int, int] | None = None  # the last episode and step of the source
        self._planned, self._news_s = (-1, -1), time.monotonic()

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes any message."""
        if topic.in_step:
            self._news_s = time.monotonic()
        if isinstance(message, Result):
            self.results[message.episode] = message
        elif topic == PLAN:
            self._planned = max(self._planned, (message.episode, message.step))
        elif isinstance(message, Status) and part == self._source and message.state == "finished":
            self._end = (message.episode, message.step)

    @property
    def over(self) -> bool:
        """Whether the source has finished and every episode has its result. If nobody judges, the last frame must have
        its plan instead."""
        if self._end is None:
            return False
        if self._judged:
            return len(self.results) > self._end[0]
        return self._planned >= self._end or time.monotonic() - self._news_s > WORKED_OFF_S


def _drain(messages: Iterator[Told | None], on_message: OnMessage | None) -> None:
    """Takes the messages that were still on their way when the services were stopped."""
    while on_message is not None and (item := next(messages)) is not None:
        on_message(*item)


@contextmanager
def _terminable() -> Iterator[None]:
    """Within this context SIGTERM ends the run like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
