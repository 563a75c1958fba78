"""A whole agent on this machine: the bus, one process per service, and their end."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from deploy.threads import VARIABLES
from services.simulator.objects import names_of
from shared.bus import ZenohBus, free_endpoint
from shared.config import REPOSITORY, Config
from shared.errors import SaccadeError
from shared.loop import READY_STATES
from shared.messages import Message, MessageError, Result, decode
from shared.process import LAUNCHER_VARIABLE
from shared.topics import RESULT, STATUS, Topic

OnMessage = Callable[[Topic, str | None, Message], None]
CONFIG_NAME = "config.json"
LOG_NAME = "run.mcap"
LOGS_NAME = "logs"
READY_S = 120.0  # loading weights on a busy machine takes its time
STOP_S = 10.0  # then a service that was told to stop is killed
POLL_S = 0.2


@dataclass(frozen=True)
class Process:
    """One service's process: `python -m <module>`."""

    name: str
    module: str


# In the order of the data: stopped in this order, each works off what the one before it has sent.
PROCESSES = tuple(Process(name, f"services.{name}") for name in (
    "simulator", "perception", "belief", "planner", "evaluator", "recorder"))


def launch(config: Config, run_dir: Path, on_message: OnMessage | None = None,
           processes: Sequence[Process] = PROCESSES) -> list[Result]:
    """Runs all episodes, one process per service, and returns their results in order; the log is `run_dir`/run.mcap.

    `on_message(topic, part, message)` sees every valid message, on the caller's thread. The first process is the
    source. Raises SaccadeError, naming the service, if one ends before its time or is not ready within READY_S.
    """
    _prepare(run_dir)
    config = resolve(config, processes)
    config.save(run_dir / CONFIG_NAME)
    arrived: queue.SimpleQueue = queue.SimpleQueue()
    with ExitStack() as stack:
        stack.enter_context(_terminable())
        bus = ZenohBus(config.bus.endpoint, world=config.bus.world, listen=True)
        stack.callback(bus.close)
        bus.subscribe(None if on_message else (STATUS, RESULT), lambda *item: arrived.put(item))
        children: dict[str, subprocess.Popen] = {}
        stack.callback(_stop, children)
        for process in processes:
            children[process.name] = _start(process, run_dir)
        results = _follow(_messages(arrived, children, run_dir), processes, on_message)
        _stop(children)
        _drain(arrived, on_message)
        _warn(children, run_dir)
    return results


def resolve(config: Config, processes: Sequence[Process] = PROCESSES) -> Config:
    """The configuration as the processes read it: objects named, a free port, who must be ready first."""
    names = config.scene.names or names_of(config.scene.objects)
    return config.with_values({"bus.endpoint": free_endpoint(config.bus.endpoint), "scene.names": list(names),
                               "bus.wait_for": [process.name for process in processes[1:]]})


def _prepare(run_dir: Path) -> None:
    if (run_dir / LOG_NAME).exists():
        raise SaccadeError(f"run folder {run_dir} already holds a log; choose another, or move it away")
    try:
        (run_dir / LOGS_NAME).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SaccadeError(f"run folder {run_dir} cannot be made: {error.strerror}") from error


def _start(process: Process, run_dir: Path) -> subprocess.Popen:
    path = os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH"))))
    environment = {**dict.fromkeys(VARIABLES, "1"), **os.environ, "PYTHONPATH": path,
                   LAUNCHER_VARIABLE: str(os.getpid())}
    with _log_path(run_dir, process.name).open("wb") as log:
        return subprocess.Popen(  # a session of its own: Ctrl-C reaches the launcher, which then stops all in order
            [sys.executable, "-m", process.module, "--config", str(run_dir / CONFIG_NAME)], env=environment,
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


def _messages(arrived: queue.SimpleQueue, children: dict[str, subprocess.Popen], run_dir: Path) -> Iterator:
    """(topic, part, message) as they arrive, and None when nothing did; raises SaccadeError if a child has ended."""
    looked_s = time.monotonic()
    while True:
        if time.monotonic() - looked_s >= POLL_S:
            looked_s = time.monotonic()
            for name, child in children.items():
                if child.poll() is not None:
                    raise SaccadeError(f"{name}: {_last_line(run_dir, name, child.returncode)}")
        item = None
        with suppress(queue.Empty, MessageError):  # whoever subscribes to an invalid message counts it
            topic, part, payload = arrived.get(timeout=POLL_S)
            item = (topic, part, decode(topic.type, payload))
        yield item


def _follow(messages: Iterator, processes: Sequence[Process], on_message: OnMessage | None) -> list[Result]:
    results: dict[int, Result] = {}
    starting = {process.name for process in processes}
    episodes, deadline_s = None, time.monotonic() + READY_S
    for item in messages:
        if starting and time.monotonic() > deadline_s:
            raise SaccadeError(f"{', '.join(sorted(starting))}: not ready after {READY_S:.0f} s; see {LOGS_NAME}/")
        if item is None:
            continue
        topic, part, message = item
        if on_message is not None:
            on_message(topic, part, message)
        if topic == RESULT:
            results[message.episode] = message
        elif topic == STATUS and message.state in READY_STATES:
            starting.discard(part)
        elif topic == STATUS and part == processes[0].name and message.state == "finished":
            episodes = message.episode + 1
        if episodes is not None and len(results) >= episodes:
            break
    return [results[episode] for episode in sorted(results)]


def _stop(children: dict[str, subprocess.Popen]) -> None:
    for child in children.values():
        try:
            if child.poll() is None:
                child.terminate()
                child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        except BaseException:  # interrupted once more: no orphans, whatever happens
            for other in children.values():
                other.kill()
                other.wait()
            raise


def _drain(arrived: queue.SimpleQueue, on_message: OnMessage | None) -> None:
    while on_message is not None and not arrived.empty():
        topic, part, payload = arrived.get()
        with suppress(MessageError):
            on_message(topic, part, decode(topic.type, payload))


def _warn(children: dict[str, subprocess.Popen], run_dir: Path) -> None:
    """The results are there; what went wrong beside them (a full disk under the log) is said, not raised."""
    for name, child in children.items():
        if child.returncode:
            print(f"saccade: {name}: {_last_line(run_dir, name, child.returncode)}", file=sys.stderr)


def _log_path(run_dir: Path, name: str) -> Path:
    return run_dir / LOGS_NAME / f"{name}.log"


def _last_line(run_dir: Path, name: str, code: int) -> str:
    lines = _log_path(run_dir, name).read_text(errors="replace").strip().splitlines()
    reason = lines[-1].removeprefix("saccade: ") if lines else "it said nothing"
    how = f"ended with code {code}" if code >= 0 else f"was ended by signal {signal.Signals(-code).name}"
    return f"{reason} (it {how}; see {_log_path(run_dir, name)})"


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends the run as Ctrl-C does."""
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
