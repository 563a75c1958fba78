"""`python -m saccade.deploy.container SERVICE` runs a service where something else starts and restarts it, such as
Docker.

It runs one process for each world of the newest run in SACCADE_RUNS, or only for the world with the number
SACCADE_WORLD, until that run is over. The viewer shows only the first world, and stays for SACCADE_VIEW_S seconds after
the run. With SACCADE_WAIT set, it waits until there is a run. If a process dies or hangs, it ends with code 1, so that
it is started again. A process that says why it cannot run does not end the others. It stays down, and the exit code at
the end is 2.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from saccade.app.run.supervisor import HUNG_KILLED_S, KEEP_PAGES, STOP_S, VIEWER
from saccade.app.run.threads import VARIABLES
from saccade.shared.bus.transport import ROUTER_WAIT_VARIABLE
from saccade.shared.config import ServicesConfig, load
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME
from saccade.shared.loop.process import EXIT_ERROR, HEARTBEAT_VARIABLE, LAUNCHER_VARIABLE

RUNS_VARIABLE, HEARTBEATS_VARIABLE = "SACCADE_RUNS", "SACCADE_HEARTBEATS"
WORLD_VARIABLE, WAIT_VARIABLE = "SACCADE_WORLD", "SACCADE_WAIT"
LATEST, OVER = "latest", "over"  # a link to the newest run, and a mark in the folder of a world that is over
ONE_FOR_ALL = ("router", "viewer", "guide", "ros")  # all worlds share the router, and the others show the first world
VIEW_VARIABLE, VIEW_S = "SACCADE_VIEW_S", 300.0  # the viewer stays so long after a run
POLL_S = 0.2
ROUTER_S = 60.0  # a service waits so long for the router, because containers start in any order
# A process that is told to stop before it has begun gets less time: what it waits for may never come.
STOP_UNBEGUN_S = 3.0
EXIT_AGAIN = 1


def runs_folder() -> Path:
    """The folder of the runs: SACCADE_RUNS, else `runs`."""
    return Path(os.environ.get(RUNS_VARIABLE, "runs"))


def heartbeat_file(name: str) -> Path:
    """The file in which a process of this container says that it is well. `healthy.sh` reads it."""
    folder = Path(os.environ.get(HEARTBEATS_VARIABLE, "/tmp/heartbeats"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def worlds_of(run: Path) -> list[Path]:
    """The folders of the worlds of a run: its own folder, or those in it. It is empty if the run is over."""
    own = [run] if (run / CONFIG_NAME).is_file() else sorted(path.parent for path in run.glob(f"*/{CONFIG_NAME}"))
    return [] if all((world / OVER).exists() for world in own) else [world.resolve() for world in own]


def mine(name: str, worlds: list[Path]) -> list[Path]:
    """The worlds that this container serves. Raises SaccadeError if SACCADE_WORLD names a world that is not there."""
    if name in ONE_FOR_ALL:
        return worlds[:1]
    number = os.environ.get(WORLD_VARIABLE)
    if number is None:
        return worlds
    if not number.isdigit() or int(number) >= len(worlds):
        raise SaccadeError(f"{WORLD_VARIABLE}={number}, but the run has {len(worlds)} worlds, counted from 0")
    return [worlds[int(number)]]


def takes_part(name: str, world: Path) -> bool:
    """Whether a world needs a service. An agent may do without one of those that others have. Raises SaccadeError if
    the world's configuration cannot be read."""
    awaited = load(world / CONFIG_NAME).bus.wait_for
    if name not in ServicesConfig.model_fields or name in awaited or not awaited:
        return True
    print(f"saccade: {name} has no part in this run", file=sys.stderr, flush=True)
    return False


class Container:
    """The processes of one service, one for each world."""

    def __init__(self, name: str) -> None:
        self._name, self._stopping = name, threading.Event()
        self._children: dict[Path, subprocess.Popen] = {}

    def _start(self, world: Path) -> subprocess.Popen:
        environment = {**dict.fromkeys(VARIABLES, "1"), **KEEP_PAGES, ROUTER_WAIT_VARIABLE: str(ROUTER_S), **os.environ,
                       LAUNCHER_VARIABLE: str(os.getpid()),
                       HEARTBEAT_VARIABLE: str(self._heartbeat(world))}
        return subprocess.Popen([sys.executable, "-m", f"saccade.services.{self._name}", "--config",
                                 world / CONFIG_NAME], env=environment, start_new_session=True)

    def _heartbeat(self, world: Path) -> Path:
        """The heartbeat file of one process. The names differ, because other services may run on the same host without
        containers."""
        return heartbeat_file(f"{self._name}-{world.name}")

    def stop(self, *_: object) -> None:
        """Makes `run` end the processes. It is safe in a signal handler."""
        self._stopping.set()

    def run(self) -> int:
        """Runs until the run is over or `stop` was called. Returns the exit code. Raises SaccadeError like `mine`."""
        latest = runs_folder() / LATEST
        if not worlds_of(latest):
            if not os.environ.get(WAIT_VARIABLE):
                print(f"saccade: {self._name}: no run goes on in {runs_folder()}", file=sys.stderr)
                return 0
            print(f"saccade: {self._name} waits for a run in {runs_folder()}", file=sys.stderr, flush=True)
        while not (worlds := worlds_of(latest)):
            if self._stopping.wait(POLL_S):
                return 0
        self._children = {world: self._start(world) for world in mine(self._name, worlds)
                          if takes_part(self._name, world)}
        while not self._stopping.wait(POLL_S) and not all((world / OVER).exists() for world in worlds):
            if not self._children:  # it has no part in the run, and is well
                self._heartbeat(worlds[0]).touch()
            if self._died() or self._hung():
                self._end()
                return EXIT_AGAIN
        self._stay()
        self._end()
        return EXIT_ERROR if any(child.returncode == EXIT_ERROR for child in self._children.values()) else 0

    def _stay(self) -> None:
        """Keeps the viewer for a while after the run, so that the run can still be looked at."""
        stay_s = float(os.environ.get(VIEW_VARIABLE, VIEW_S))
        if self._name == VIEWER.name and stay_s and not self._stopping.is_set():
            print(f"saccade: the run is over; the viewer stays for {stay_s:.0f} s", file=sys.stderr, flush=True)
            self._stopping.wait(stay_s)

    def _died(self) -> bool:
        codes = {world: child.poll() for world, child in self._children.items()}
        died = {world: code for world, code in codes.items() if code not in (None, 0, EXIT_ERROR)}
        for world, code in died.items():
            how = f"ended with code {code}" if code > 0 else f"was ended by signal {-code}"
            hint = ": was there enough memory?" if code == -signal.SIGKILL else ""
            print(f"saccade: {self._name} in {world.name} {how}{hint}", file=sys.stderr)
        return bool(died)

    def _hung(self) -> bool:
        for world, child in self._children.items():
            file = self._heartbeat(world)
            if child.poll() is None and file.exists() and time.time() - file.stat().st_mtime > HUNG_KILLED_S:
                print(f"saccade: {self._name} hung for {HUNG_KILLED_S:.0f} s: it is ended", file=sys.stderr)
                child.kill()
                return True
        return False

    def _end(self) -> None:
        for child in self._children.values():
            child.terminate()
        told_s = time.monotonic()
        for world, child in self._children.items():
            for_s = STOP_S - 1 if self._heartbeat(world).exists() else STOP_UNBEGUN_S  # Docker kills after STOP_S
            try:
                child.wait(max(0.1, told_s + for_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the service that the command line names. If it cannot, it prints one line and ends with exit code 2."""
    name, = sys.argv[1:] if argv is None else argv
    container = Container(name)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, container.stop)
    try:
        sys.exit(container.run())
    except SaccadeError as error:
        print(f"saccade: {name}: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)


if __name__ == "__main__":
    main()
