"""Starts a whole agent on this machine: the bus and one process for each service. It ends them when the run is over."""

from __future__ import annotations

import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from saccade.app.run.follow import FOLLOWED, JUDGE, READY_S, Messages, OnMessage, follow
from saccade.app.run.supervisor import Process, Supervisor
from saccade.services.recorder.core import complete
from saccade.shared.bus.messages import Result, Status
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.transport import Bus, ZenohBus, free_endpoint
from saccade.shared.config import Config
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable
from saccade.shared.log.folder import CONFIG_NAME, LOG_NAME, LOGS_NAME
from saccade.shared.log.reading import is_whole
from saccade.shared.loop.episodes import READY_STATES, RECORDER
from saccade.shared.loop.process import Item
from saccade.shared.render.objects import names_of

CONNECT_S = 10.0  # a router on this machine answers at once

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
        if on_message is not None:
            for item in graph.messages.rest():
                on_message(*item)
        lacks = graph.supervisor.complaints()  # such as a full disk
        if graph.supervisor.was_killed(RECORDER) and not is_whole(run_dir / LOG_NAME):
            complete(run_dir, config)
            lacks.append(f"the recorder was killed before it had closed {run_dir / LOG_NAME}: the log has its index "
                         "now, and `saccade log check` says what it lacks")
        for complaint in lacks:
            print(f"saccade: {printable(complaint, LINE_LIMIT)}", file=sys.stderr)
        yield Ended(results, graph.supervisor.runs, tuple(lacks))


@dataclass(frozen=True)
class Graph:
    """Processes that run, and a client on their bus. While `messages` is iterated, the processes are watched."""

    bus: Bus
    supervisor: Supervisor
    messages: Messages


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
        stream = Messages(arrived, bus, supervisor, config.run or run_dir.name, say)
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


def _await_router(messages: Messages, router: Process) -> None:
    deadline_s = time.monotonic() + READY_S
    for item in messages:
        if item and item[1] == router.name and isinstance(item[2], Status) and item[2].state in READY_STATES:
            return
        if time.monotonic() > deadline_s:
            raise SaccadeError(f"{router.name}: not ready after {READY_S:.0f} s; see {LOGS_NAME}/")


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
