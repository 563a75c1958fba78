"""`python -m saccade.deploy.container SERVICE`: a service where something else starts and restarts it, such as Docker.

One process for each world of the newest run in SACCADE_RUNS, or for world number SACCADE_WORLD alone, until that run is
over; the viewer shows the first of them and stays for SACCADE_VIEW_S seconds more. With SACCADE_WAIT set it waits until
there is one. It ends with code 1 when one of them died or hung, so that it is started again; a service that said why it
cannot run stays down until then.
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
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME
from saccade.shared.loop.process import EXIT_ERROR, HEARTBEAT_VARIABLE, LAUNCHER_VARIABLE

RUNS_VARIABLE, HEARTBEATS_VARIABLE = "SACCADE_RUNS", "SACCADE_HEARTBEATS"
WORLD_VARIABLE, WAIT_VARIABLE = "SACCADE_WORLD", "SACCADE_WAIT"
LATEST, OVER = "latest", "over"  # in the folder of the runs, and in the one of a run
ONE_FOR_ALL = ("router", "viewer")  # worlds share the first, and the other shows the first of them
VIEW_VARIABLE, VIEW_S = "SACCADE_VIEW_S", 300.0  # for so long a run that is over can still be looked at
POLL_S = 0.2
ROUTER_S = 60.0  # for the router to answer: containers start in any order
STOP_UNBEGUN_S = 3.0  # for a process that is told to stop before it has begun: what it waits for may not come any more
EXIT_AGAIN = 1


def runs_folder() -> Path:
    """Where runs are, for containers."""
    return Path(os.environ.get(RUNS_VARIABLE, "runs"))


def heartbeat_file(name: str) -> Path:
    """Where a container's process says that it is well; `healthy.sh` looks there."""
    folder = Path(os.environ.get(HEARTBEATS_VARIABLE, "/tmp/heartbeats"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def worlds_of(run: Path) -> list[Path]:
    """The folders of the worlds of a run that goes on: its own, or those in it; none where it is over."""
    own = [run] if (run / CONFIG_NAME).is_file() else sorted(path.parent for path in run.glob(f"*/{CONFIG_NAME}"))
    return [] if all((world / OVER).exists() for world in own) else [world.resolve() for world in own]


def mine(name: str, worlds: list[Path]) -> list[Path]:
    """Those that this container serves. Raises SaccadeError where it is told to serve one that is not there."""
    if name in ONE_FOR_ALL:
        return worlds[:1]
    number = os.environ.get(WORLD_VARIABLE)
    if number is None:
        return worlds
    if not number.isdigit() or int(number) >= len(worlds):
        raise SaccadeError(f"{WORLD_VARIABLE}={number}, but the run has {len(worlds)} worlds, counted from 0")
    return [worlds[int(number)]]


class Container:
    """The processes of one service."""

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
        """Of one of its own: other services may be on the same host, without containers."""
        return heartbeat_file(f"{self._name}-{world.name}")

    def stop(self, *_: object) -> None:
        """Ends them; safe in a signal handler."""
        self._stopping.set()

    def run(self) -> int:
        """Until the run is over or `stop` was called; the exit code. Raises SaccadeError, see `mine`."""
        latest = runs_folder() / LATEST
        if not worlds_of(latest):
            if not os.environ.get(WAIT_VARIABLE):
                print(f"saccade: {self._name}: no run goes on in {runs_folder()}", file=sys.stderr)
                return 0
            print(f"saccade: {self._name} waits for a run in {runs_folder()}", file=sys.stderr, flush=True)
        while not (worlds := worlds_of(latest)):
            if self._stopping.wait(POLL_S):
                return 0
        self._children = {world: self._start(world) for world in mine(self._name, worlds)}
        while not self._stopping.wait(POLL_S) and not all((world / OVER).exists() for world in worlds):
            if self._died() or self._hung():
                self._end()
                return EXIT_AGAIN
        self._stay()
        self._end()
        return EXIT_ERROR if any(child.returncode == EXIT_ERROR for child in self._children.values()) else 0

    def _stay(self) -> None:
        """A run that is over can still be looked at."""
        stay_s = float(os.environ.get(VIEW_VARIABLE, VIEW_S))
        if self._name == VIEWER.name and stay_s and not self._stopping.is_set():
            print(f"saccade: the run is over and stays to be seen for {stay_s:.0f} s", file=sys.stderr, flush=True)
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
    """Exit code 2, with one line, where it cannot."""
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
